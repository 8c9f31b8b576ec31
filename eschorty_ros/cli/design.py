"""`eschorty design`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from eschorty_ros.cli.console import decimals, show, table

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eschorty_ros.core.optics import Design


@click.command("design")
@click.option("--focal-mm", type=float, default=24.0, show_default=True, help="Focal length, mm.")
@click.option("--f-number", type=float, default=2.0, show_default=True, help="Aperture.")
@click.option(
    "--theta-deg", type=float, default=85.87, show_default=True, help="Tilt of the laser sheet."
)
@click.option("--theta-prime-deg", type=float, help="Tilt of the sensor; with --near-mm.")
@click.option(
    "--near-mm", type=float, default=810.45, show_default=True, help="Range at row 0, mm."
)
@click.option(
    "--far-mm", type=float, help="Range at the last row, mm; finds the sensor tilt by itself."
)
@click.option("--b-mm", type=float, default=0.0, show_default=True, help="Datum to focal line, mm.")
@click.option(
    "--ranges", type=click.IntRange(2, 100), default=8, show_default=True, help="Table rows."
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Also write the plots here, .png, .pdf or .svg.",
)
def command(
    focal_mm: float,
    f_number: float,
    theta_deg: float,
    theta_prime_deg: float | None,
    near_mm: float,
    far_mm: float | None,
    b_mm: float,
    ranges: int,
    out: Path | None,
) -> None:
    """Tabulate range, sampling and depth of field of an optical build.

    Give the sensor tilt (--theta-prime-deg) or the far range (--far-mm); without either, the tilt
    is -7.77 degrees, the nominal design. Depth of field is a focus tolerance, not a range error.

    \b
    Examples:
      eschorty design
      eschorty design --near-mm 500 --far-mm 1500
      eschorty design --focal-mm 24 --f-number 2 --theta-deg 85.87 --theta-prime-deg -7.62 \\
                      --near-mm 784.6 --out design.png
    """  # noqa: D301
    import numpy as np

    from eschorty_ros.core.optics import design, design_for_ranges

    if theta_prime_deg is not None and far_mm is not None:
        raise click.UsageError("give --theta-prime-deg or --far-mm, not both")
    if far_mm is not None:
        build = design_for_ranges(
            focal_length_mm=focal_mm,
            f_number=f_number,
            theta_deg=theta_deg,
            near_mm=near_mm,
            far_mm=far_mm,
            b_mm=b_mm,
        )
    else:
        build = design(
            focal_length_mm=focal_mm,
            f_number=f_number,
            theta_deg=theta_deg,
            theta_prime_deg=-7.77 if theta_prime_deg is None else theta_prime_deg,
            near_mm=near_mm,
            b_mm=b_mm,
        )
    near, far = build.range_limits_mm
    # A pole on the sensor puts the last row at infinity.
    last = far if np.isfinite(far) else 20.0 * near
    _print(build, np.linspace(near, last, ranges))
    if out is not None:
        _draw(build, np.linspace(near, last, 400), out)
        click.echo(str(out))


def _print(build: Design, range_mm: NDArray[np.float64]) -> None:
    near, far = build.range_limits_mm
    made = table(
        f"f {build.focal_length_mm:g} mm, f/{build.f_number:g}, sheet {build.theta_deg:g}°, sensor "
        f"{build.theta_prime_deg:.3f}°: {near:.1f} to {far:.1f} mm",
        *("range mm", "row px", "mm/row", "mm/column", "± focus mm", "swath mm"),
    )
    at = build.at(range_mm)
    columns = [
        (at.range_mm, max(decimals(at.range_mm), 1)),
        (at.row, 1),
        *(
            (values, decimals(values))
            for values in (
                at.range_per_row_mm, at.lateral_pitch_mm, at.depth_of_field_mm, at.swath_mm,
            )
        ),
    ]  # fmt: skip
    for index in range(len(range_mm)):
        made.add_row(*(f"{values[index]:.{places}f}" for values, places in columns))
    show(made)
    click.echo(
        f"k {build.model.k_mm:.4f} mm, k' {build.model.k_prime_px:.2f} px, "
        f"b' {build.model.b_prime_px:.2f} px, field {build.field_deg:.2f}°, "
        f"lens to Scheimpflug line {build.baseline_mm:.2f} mm"
    )


def _draw(build: Design, range_mm: NDArray[np.float64], out: Path) -> None:
    from eschorty_ros.report import figures

    title = (
        f"f {build.focal_length_mm:g} mm, f/{build.f_number:g}, "
        f"sensor tilt {build.theta_prime_deg:.2f}°"
    )
    figures.save(figures.design_figure(build.at(range_mm), title), out)
