"""Contradictions within the paper or with its equations, and the right values."""

from __future__ import annotations

from eschorty_experiments._builds import beam_rows
from eschorty_ros.core.optics import Design
from eschorty_ros.report.experiment import DataTable


def disagreements(made: dict[str, Design]) -> DataTable:
    """Return the printed statements with right value and reason.

    - ``made``: The four builds of Table 1 by name.
    """
    return DataTable(
        ["where", "printed", "from_the_equations", "why"],
        [*_of_table_1(made), *_of_table_2(made), *_of_scans(made), *_OF_THE_TEXT],
    )


def _of_table_1(made: dict[str, Design]) -> list[list[str]]:
    nominal, final = made["nominal"].model, made["config_3"].model
    last, beyond = nominal.range_mm([719.0, 720.0])
    return [
        [
            "Table 1, far range of the design",
            "2413.54 mm",
            f"{last:.2f} mm at row 719",
            f"the design uses row 720 ({beyond:.2f} mm), the builds row 719",
        ],
        [
            "Table 1, kk'",
            "with k = 24.06 mm",
            f"k = {nominal.k_mm:.7f} mm",
            "kk' uses the rounded k, the ranges the unrounded one: 1 part in 10000",
        ],
        [
            "Table 1, kk' of Config 3",
            "-896502 mm px",
            f"{24.06 * final.k_prime_px:.0f} (k rounded), {final.product_mm_px:.0f} (unrounded)",
            "neither convention gives the print; the printed ranges imply "
            f"{784.61 * final.b_prime_px:.0f}",
        ],
        [
            "Eqs. 1 and 2, m = R'/k'",
            "R' is a row",
            "m = (row + b') / k'",
            "R' is counted from the back focal line in Eq. 1 and from the first row in Eq. 2",
        ],
    ]


def _of_table_2(made: dict[str, Design]) -> list[list[str]]:
    nominal, final = made["nominal"].model, made["config_3"].model
    near, far = (final.range_per_row_mm(mm) for mm in (800.0, 2500.0))
    n_near, n_far = (nominal.range_per_row_mm(mm) for mm in (800.0, 2500.0))
    return [
        [
            "Table 2, depth sampling",
            "0.9 mm at 0.8 m, 2.8 mm at 2.5 m",
            f"{near:.2f} and {far:.2f} mm (Config 3), {n_near:.2f} and {n_far:.2f} mm (design)",
            f"the print is the step over the range: {near / 0.8:.2f} and {far / 2.5:.2f} mm per m",
        ],
        [
            "text, depth sampling",
            "about 0.1 % of the range",
            f"{near / 8.0:.3f} % near, {far / 25.0:.2f} % far",
            "the step grows with the square of the range",
        ],
        [
            "Table 2, working distance",
            "0.8 to 2.5 m",
            f"Config 3 ends at {final.range_limits_mm[1] * 1e-3:.3f} m",
            "the final build has a shorter near range at the cost of the far range",
        ],
    ]


def _of_scans(made: dict[str, Design]) -> list[list[str]]:
    rows = {name: float(build.model.row(2430.0)) for name, build in made.items()}
    nominal = made["nominal"]
    step = {name: float(build.model.range_per_row_mm(1320.0)) for name, build in made.items()}
    axis_m = nominal.axis_range_mm * 1e-3
    pitch_rad = nominal.model.slope_per_column
    focus_mm = float(nominal.at([1320.0]).depth_of_field_mm[0])
    return [
        [
            "Fig. 8, faces",
            "at 2.43 m, elsewhere about 1 m",
            f"row {rows['config_3']:.0f} in Config 3, {rows['config_1']:.0f} in Config 1, "
            f"{rows['nominal']:.0f} in the design, {rows['config_2']:.0f} in Config 2",
            "the sensor ends at row 719: only Config 2 covers 2.43 m",
        ],
        [
            "Fig. 8, point spacing",
            "0.631 m across, 0.355 m along",
            f"{pitch_rad * 2430.0:.3f} mm and {300.0 / 70.0:.2f} mm at 2.43 m",
            f"the print is the footprint of 1280 and 720 pixels at {axis_m:.3f} m, "
            f"{1280 * pitch_rad * axis_m:.3f} m and {720 * pitch_rad * axis_m:.3f} m",
        ],
        [
            "Fig. 8, separations",
            "2.2 mm at 1.32 m",
            f"one row is {step['nominal']:.2f} mm (design), {step['config_3']:.2f} (Config 3), "
            f"{step['config_1']:.2f} (Config 1)",
            f"the depth of field there is ±{focus_mm:.0f} mm: a focus tolerance, no range error",
        ],
        [
            "Fig. 4, residuals",
            "within the depth of field",
            f"depth of field is {nominal.depth_of_field_rows:.1f} rows at every range",
            "more than ten times too weak a gate; residuals belong in rows",
        ],
        [
            "text, 1 mrad beam and 20 row line",
            "both",
            f"1 mrad is {beam_rows(nominal):.1f} rows",
            "20 rows is the width in events of a sensor with logarithmic response",
        ],
    ]


_OF_THE_TEXT: tuple[list[str], ...] = (
    [
        "text, event rates",
        "million megaevents per second",
        "0.01 to 1 Mev/s shown; 128 M/s is 1280 columns at 100 kHz for one row",
        "an error of units",
    ],
    [
        "text, breakdown",
        "increased event rate (methods), fewer events (results)",
        "fewer events",
        "the swing falls below the thresholds",
    ],
    [
        "text, axes",
        "1280 rows, x is a row",
        "1280 columns along the line, 720 rows along the range",
        "names swapped",
    ],
    [
        "text, column mean",
        "justified by a zero-mean Gaussian",
        "uniform background biases the mean towards the middle row",
        "background is not Gaussian; the default estimator is robust to it",
    ],
    [
        "Fig. 7, linear extrapolation",
        "7.5 px",
        "10 to 29 px in simulation",
        "it depends on the first two points",
    ],
    [
        "text, drift formula",
        "-2 log R + log σ² against -log reflectance",
        "distinct names here",
        "signs and symbols conflict: R is range and reflectance, sigma width and divergence",
    ],
    [
        "text, anti-flicker",
        "listed as active",
        "band stop must be off",
        "its 50 to 520 Hz band is the modulation band",
    ],
)
