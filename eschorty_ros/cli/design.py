"""`eschorty design`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from eschorty_ros.cli.console import decimals, show, table, warn
from eschorty_ros.cli.files import (
    OUT_FILE,
    check_output,
    check_picture,
    is_yaml,
    report_replaced,
)
from eschorty_ros.cli.options import Integer, Number, refuse_given

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eschorty_ros.core.optics import Design

# Light of one period at 70 Hz and duty 0.5.
_LIGHT_S = 0.5 / 70.0


@click.command("design")
@click.option(
    "--focal-mm",
    "focal_length_mm",
    type=Number(),
    default=24.0,
    show_default=True,
    help="Focal length, mm.",
)
@click.option("--f-number", type=Number(), default=2.0, show_default=True, help="Aperture.")
@click.option(
    "--theta-deg", type=Number(), default=85.87, show_default=True, help="Tilt of the laser sheet."
)
@click.option("--theta-prime-deg", type=Number(), help="Tilt of the sensor; with --near-mm.")
@click.option(
    "--near-mm", type=Number(), default=810.45, show_default=True, help="Range at row 0, mm."
)
@click.option(
    "--far-mm", type=Number(), help="Range at the last row, mm; finds the sensor tilt by itself."
)
@click.option(
    "--b-mm", type=Number(), default=0.0, show_default=True, help="Datum to focal line, mm."
)
@click.option("--ranges", type=Integer(2, 100), default=8, show_default=True, help="Table rows.")
@click.option(
    "--pixel-um", type=Number(), default=4.86, show_default=True, help="Pixel pitch of the sensor."
)
@click.option("--columns", type=int, default=1280, show_default=True, help="Columns of the sensor.")
@click.option("--rows", type=int, default=720, show_default=True, help="Rows of the sensor.")
@click.option(
    "--power-mw", type=Number(), help="Peak power of the line: adds photons and an estimated class."
)
@click.option(
    "--wavelength-nm", type=Number(), default=450.0, show_default=True, help="With --power-mw."
)
@click.option(
    "--out",
    "outs",
    multiple=True,
    type=OUT_FILE,
    help="Also write the build, .yaml, or its plots, .png, .pdf or .svg; again for both.",
)
def command(
    theta_prime_deg: float | None,
    far_mm: float | None,
    ranges: int,
    power_mw: float | None,
    wavelength_nm: float,
    outs: tuple[Path, ...],
    **given: Any,
) -> None:
    """Tabulate range, sampling and depth of field of an optical build.

    Give the sensor tilt (--theta-prime-deg) or the far range (--far-mm); without either, the tilt
    is -7.77 degrees, the nominal design. Depth of field is a focus tolerance, not a range error.
    The laser's class is an estimate after IEC 60825-1, not a safety statement.

    \b
    Examples:
      eschorty design
      eschorty design --near-mm 500 --far-mm 1500
      eschorty design --focal-mm 24 --f-number 2 --theta-deg 85.87 --theta-prime-deg -7.62 \\
                      --near-mm 784.6 --out design.png
      eschorty design --near-mm 500 --far-mm 1500 --power-mw 40 --out my.yaml
    """  # noqa: D301
    import numpy as np

    from eschorty_ros.core.optics import design, design_for_ranges, save_calibration

    if power_mw is None:
        refuse_given(["wavelength_nm"], "belongs to --power-mw")
    if theta_prime_deg is not None and far_mm is not None:
        raise click.UsageError("give --theta-prime-deg or --far-mm, not both")
    for name, range_mm in (("near", given["near_mm"]), ("far", far_mm)):
        if range_mm is not None and 0.0 < range_mm < given["focal_length_mm"]:
            warn(
                f"--{name}-mm is {range_mm:g} mm, less than the focal length; ranges are in mm, "
                f"{range_mm:g} m are {1e3 * range_mm:g}"
            )
    for out in outs:
        if is_yaml(out):
            check_output(out)
        else:
            check_picture(out, others=(".yaml",))
    if far_mm is not None:
        build = design_for_ranges(far_mm=far_mm, **given)
    else:
        tilt_deg = -7.77 if theta_prime_deg is None else theta_prime_deg
        build = design(theta_prime_deg=tilt_deg, **given)
    near, far = build.range_limits_mm
    # A pole on the sensor puts the last row at infinity.
    last = far if np.isfinite(far) else 20.0 * near
    # A value that is refused comes before the table.
    light = ""
    if power_mw is not None:
        light = _light(build, near, min(far, last), power_mw, wavelength_nm)
    _print(build, np.linspace(near, last, ranges))
    if light:
        click.echo(light)
    for out in outs:
        report_replaced(out)
        if is_yaml(out):
            save_calibration(build.calibration(out.stem), out)
        else:
            _draw(build, np.linspace(near, last, 400), out)
        click.echo(str(out))


def _light(
    build: Design, near_mm: float, far_mm: float, power_mw: float, wavelength_nm: float
) -> str:
    """Return the photons of the line per column and the laser's class, in two lines."""
    from eschorty_ros.core.optics import laser_class, photons_per_column

    photons = [
        photons_per_column(build, range_mm, power_mw, wavelength_nm, _LIGHT_S)
        for range_mm in (near_mm, far_mm)
    ]
    found = laser_class(power_mw, wavelength_nm, build.field_deg)
    limits = ", ".join(f"{name}: {limit:.3g}" for name, limit in found.limits_mw.items())
    return (
        f"{power_mw:g} mW at {wavelength_nm:g} nm: {photons[0]:.2g} to {photons[1]:.2g} photons "
        f"per column in {_LIGHT_S * 1e3:.1f} ms from white, nearest to farthest\n"
        f"class {found.name} by estimate, not a safety statement: {found.accessible_mw:.3g} mW "
        f"through 7 mm at 100 mm (limits in mW {limits}; IEC 60825-1)"
    )


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
