"""Tables 1 and 2 of the paper, computed from its equations, beside the printed values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from eschorty_experiments._builds import BEAM_MRAD, beam_rows, builds
from eschorty_experiments._disagreements import disagreements
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.optics import Design, load_calibration
from eschorty_ros.report.experiment import (
    DataTable,
    Effort,
    Experiment,
    Finding,
    Outcome,
)
from eschorty_ros.report.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PRINTED_K_MM = 24.06
MODULATIONS_HZ = (70.0, 1000.0)
# Print at the ends of the working distance of Table 2.
PRINTED_STEP_MM = {800.0: 0.9, 2500.0: 2.8}


@dataclass(frozen=True, slots=True)
class Printed:
    """A line of Table 1 as printed.

    ``far_row`` is the row whose range is printed as the far one: the design counts 720 rows from
    0, the builds take the centre of the last row.
    """

    product_mm_px: float
    near_mm: float
    far_mm: float
    far_row: float


TABLE_1 = {
    "nominal": Printed(-878437.0, 810.45, 2413.54, 720.0),
    "config_1": Printed(-779774.0, 718.07, 2124.69, 719.0),
    "config_2": Printed(-900176.0, 837.23, 2526.73, 719.0),
    "config_3": Printed(-896502.0, 784.61, 2115.93, 719.0),
}


def run(effort: Effort, progress: Progress) -> Outcome:
    """Compute both tables; closed forms, so a fast run is the same."""
    made = builds()
    progress(0.3, "Tables 1 and 2")
    figure = _figure(made)
    return Outcome(
        findings=_table_1_findings(made) + _table_2_findings(made),
        tables={
            "table_1": _table_1(made),
            "table_2": _table_2(made),
            "disagreements": disagreements(made),
        },
        figures={"sampling": figure},
        captions={
            "table_1": "Table 1: the builds as printed and from Eqs. 1 and 2",
            "table_2": "Table 2: performance as printed and from the equations",
            "disagreements": "Where the print disagrees with itself or with the equations",
            "sampling": "Range step of one row (Eq. 4) of the four builds. The printed depth "
            "sampling (circles) fits the step divided by the range (dashed), in mm per metre, "
            "not the step itself.",
        },
        remarks=[
            "The package uses row centres 0 to 719 and k = f / sin θ unrounded. The print mixes "
            "rounded and unrounded k, and row 719 with row 720; each printed range is reproduced "
            "with the convention stated in the column far_row.",
            "Config 3 prints kk' = -896502 mm px. Its k' with k = 24.06 mm gives -896520, and no "
            "convention found gives the print; its ranges are right.",
            "Table 2 prints a range step 2.5 times finer than Eq. 4 at 2.5 m: the numbers are "
            "the step relative to the range, in mm per metre.",
        ],
    )


def _table_1(made: dict[str, Design]) -> DataTable:
    rows: list[list[float | str]] = []
    for name, build in made.items():
        printed, model = TABLE_1[name], build.model
        near, far = model.range_mm([0.0, printed.far_row])
        rows.append(
            [
                name,
                model.k_prime_px,
                model.b_prime_px,
                -abs(load_calibration(name).theta_prime_deg),
                build.theta_prime_deg,
                printed.product_mm_px,
                PRINTED_K_MM * model.k_prime_px,
                model.product_mm_px,
                printed.near_mm,
                float(near),
                printed.far_mm,
                float(far),
                printed.far_row,
                model.range_limits_mm[1],
                build.baseline_mm,
            ]
        )
    return DataTable(
        [
            "build",
            "k_prime_px",
            "b_prime_px",
            "theta_prime_printed_deg",
            "theta_prime_deg",
            "product_printed_mm_px",
            "product_with_k_24.06_mm_px",
            "product_mm_px",
            "near_printed_mm",
            "near_mm",
            "far_printed_mm",
            "far_mm",
            "far_row",
            "range_at_row_719_mm",
            "baseline_mm",
        ],
        rows,
    )


def _table_1_findings(made: dict[str, Design]) -> list[Finding]:
    near, far, tilt, product = [], [], [], {}
    for name, build in made.items():
        printed = TABLE_1[name]
        ranges = build.model.range_mm([0.0, printed.far_row])
        near.append(abs(ranges[0] - printed.near_mm))
        far.append(abs(ranges[1] - printed.far_mm))
        tilt.append(abs(build.theta_prime_deg - load_calibration(name).theta_prime_deg))
        product[name] = abs(PRINTED_K_MM * build.model.k_prime_px - printed.product_mm_px)
    off = product.pop("config_3")
    return [
        Finding("Table 1: largest difference of the near range to the print", max(near), high=0.03,
                unit="mm"),
        Finding("Table 1: largest difference of the far range to the print", max(far), high=0.03,
                unit="mm"),
        Finding("Table 1: largest difference of the sensor tilt to the print", max(tilt),
                high=0.005, unit="deg"),
        Finding("Table 1: largest difference of kk' with k = 24.06 mm, Config 3 apart",
                max(product.values()), high=1.0, unit="mm px"),
        Finding("Table 1: kk' of Config 3 against its print, a misprint", off, 17.0, 20.0,
                "mm px"),
    ]  # fmt: skip


def _table_2(made: dict[str, Design]) -> DataTable:
    final, nominal = made["config_3"], made["nominal"]
    columns = final.model.columns

    rows: list[list[str]] = [
        [
            "working distance",
            "0.8 to 2.5",
            *("{:.3f} to {:.3f}".format(*(mm * 1e-3 for mm in b.range_limits_mm))
              for b in (nominal, final)),
            "m",
        ],
        ["scan angle", "14", *(f"{b.field_deg:.2f}" for b in (nominal, final)), "deg"],
    ]  # fmt: skip
    for range_mm, printed_mm in PRINTED_STEP_MM.items():
        steps = [float(b.model.range_per_row_mm(range_mm)) for b in (nominal, final)]
        at = f"at {range_mm * 1e-3:g} m"
        rows += [
            [f"depth sampling {at}", f"{printed_mm:g}", *(f"{s:.2f}" for s in steps), "mm"],
            [
                f"the same over the range {at}",
                f"{printed_mm:g}",
                *(f"{s / range_mm * 1e3:.2f}" for s in steps),
                "mm per m",
            ],
        ]
    rows += [
        [f"along track, a beam of {BEAM_MRAD:g} mrad", "",
         *(f"{beam_rows(b):.2f}" for b in (nominal, final)), "rows"],
        ["across track", "200",
         *(f"{b.model.slope_per_column * 1e6:.2f}" for b in (nominal, final)), "µrad"],
        ["points across", "1280", str(nominal.model.columns), str(columns), "px"],
        *([f"points per second at {hz:g} Hz", f"{1280 * hz:.0f}", f"{columns * hz:.0f}",
           f"{columns * hz:.0f}", "1/s"] for hz in MODULATIONS_HZ),
    ]  # fmt: skip
    return DataTable(["quantity", "printed", "nominal", "config_3", "unit"], rows)


def _table_2_findings(made: dict[str, Design]) -> list[Finding]:
    final = made["config_3"]
    relative = {
        range_mm: float(final.model.range_per_row_mm(range_mm)) / range_mm * 1e3
        for range_mm in PRINTED_STEP_MM
    }
    apart = max(abs(relative[at] - printed) for at, printed in PRINTED_STEP_MM.items())
    coarser = float(final.model.range_per_row_mm(2500.0)) / PRINTED_STEP_MM[2500.0]
    return [
        Finding("Table 2: depth sampling read as mm per metre, largest difference to the print",
                apart, high=0.05, unit="mm per m"),
        Finding("Table 2: range step at 2.5 m over the print, a misprint", coarser,
                2.4, 2.6),
        Finding("Table 2: column pitch against 200 µrad", final.model.slope_per_column * 1e6,
                198.0, 202.0, "µrad"),
        Finding("Table 2: field of all columns, the laser fills 14 degrees", final.field_deg,
                14.0, 15.0, "deg"),
        Finding("Table 2: rows under a beam of 1 mrad", beam_rows(final), 4.9, 5.1, "px"),
        Finding("Table 2: points per second at 70 Hz", final.model.columns * 70.0, 89600.0, 89600.0,
                "1/s"),
    ]  # fmt: skip


def _figure(made: dict[str, Design]) -> Figure:
    figure = new_figure(8.0, 4.6)
    axes = figure.add_subplot()
    for index, (name, build) in enumerate(made.items()):
        near, far = build.range_limits_mm
        ranges = np.linspace(near, far, 200)
        step = build.model.range_per_row_mm(ranges)
        axes.plot(ranges, step, color=f"C{index}", label=name)
        axes.plot(ranges, step / ranges * 1e3, "--", color=f"C{index}", linewidth=1.0)
    axes.plot(*zip(*PRINTED_STEP_MM.items(), strict=True), "ko", label="Table 2 as printed")
    axes.plot([], [], "--", color="0.4", label="step over range (mm per m)")
    axes.set(
        xlabel="range (mm)",
        ylabel="range step of one row (mm)",
        title="Depth sampling",
        ylim=(0.0, None),
    )
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


EXPERIMENT = Experiment("tables", "Tables 1 and 2: the builds and their performance", run)
