"""Columns of the open period and the points of the closed ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import exact, whole
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.line import CLIPPED, OWN_PER_WIDTH2, check_method, half_width_fixed, noise_of
from eschorty_ros.core.line import _binning as binning
from eschorty_ros.core.line._centroid import (
    COUNTERS,
    Columns,
    Estimator,
    Scratch,
    empty_rows,
)
from eschorty_ros.core.line._row import likelihood_size
from eschorty_ros.core.line._smoothing import Smoothing
from eschorty_ros.core.line._window import BLOCK, ROW_BITS, ROW_LAST
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.phase_gate import phase_gate
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction.profiles import LineRows
from eschorty_ros.core.reconstruction.settings import Settings

_OUTPUT_PROFILES = 64


class ProfileAssembler:
    """Takes events and edges in time order, gives the rows of profiles.

    All memory the compiled pass works on lives here and is reused from period to period.

    Parameters
    ----------
    settings : Settings
    model : RangeModel

    Raises
    ------
    ArgumentError
        When the sensor has more rows than an event's packed form can hold.
    """

    def __init__(self, settings: Settings, model: RangeModel) -> None:
        if model.rows > ROW_LAST + 1:
            raise ArgumentError(
                f"rows is {model.rows}; the reconstruction takes {ROW_LAST + 1} at most"
            )
        self._done: list[LineRows] = []
        self._gate_us = settings.phase_gate_us
        self._counters = np.zeros(1, COUNTERS)[0]
        self._state = np.zeros(1, binning.STATE)[0]
        self._assembly = _assembly(settings, model)

    def restart(self, modulation: Modulation) -> None:
        """Forget the open period, the seeds and the line's width; gate by ``modulation``."""
        self._gate = phase_gate(modulation, self._gate_us)
        self._state["open"] = binning.CLOSED
        self._state["half"] = self._assembly.estimator.half_max
        self._assembly.columns.counts[:] = 0
        self._assembly.columns.seeds[:] = -1

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name."""
        return dict(zip(COUNTERS.names or (), self._counters.item(), strict=True))

    def merge(
        self,
        t: NDArray[np.int64],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        p: NDArray[np.uint8],
        edges: NDArray[np.int64],
        indices: NDArray[np.int64],
        first_edge: int,
        drain: bool,
    ) -> int:
        """Assign events to periods and close the periods whose end is reached.

        Parameters
        ----------
        t, x, y, p : int64, uint16, uint16, uint8, equal length
            Events in time order.
        edges, indices : int64, equal length
            Times and numbers of the periods' beginnings; those before ``first_edge`` are done.
        drain : bool
            No more events come before the last edge: deal with all edges.

        Returns
        -------
        int
            First edge not dealt with.
        """
        size = exact("t", t, np.int64).size
        events = binning.EventArrays(
            np.ascontiguousarray(t),
            exact("x", x, np.uint16, size),
            exact("y", y, np.uint16, size),
            exact("p", p, np.uint8, size),
        )
        times = exact("edges", edges, np.int64)
        beginnings = binning.Edges(times, exact("indices", indices, np.int64, times.size))
        progress = binning.Progress(0, whole("first_edge", first_edge, 0, times.size))
        while True:
            progress = binning._bin(
                events, beginnings, progress, drain, self._gate, self._assembly, self._state,
                self._counters,
            )  # fmt: skip
            if progress.event == size and (progress.edge == times.size or not drain):
                return int(progress.edge)
            self._collect()

    def close(self) -> None:
        """Close the open period if it holds events; it stays open for further ones."""
        if self._state["open"] == binning.FILLED:
            none = np.empty(0, dtype=np.int64)
            nowhere = np.empty(0, dtype=np.uint16)
            edge, period = (np.array([self._state[name]]) for name in ("edge_us", "period"))
            self.merge(none, nowhere, nowhere, np.empty(0, dtype=np.uint8), edge, period, 0, True)

    def take(self) -> LineRows:
        """Rows of the periods closed since the last call."""
        self._collect()
        done, self._done = self._done, []
        return done[0] if len(done) == 1 else LineRows.concatenate(done)

    def _collect(self) -> None:
        """Copy the output buffer's rows and empty it."""
        n = int(self._state["points"])
        self._state["points"] = 0
        if n == 0:
            return
        points = self._assembly.points._asdict()
        self._done.append(LineRows(**{name: values[:n].copy() for name, values in points.items()}))


def _assembly(settings: Settings, model: RangeModel) -> binning.Assembly:
    columns = model.columns
    stride = settings.column_limit + BLOCK
    method, returns = check_method(settings.centroid, settings.returns)
    half_max = half_width_fixed(settings.line_width_px)
    noise = noise_of(
        settings.centroid, settings.sigma_factor, settings.sigma_floor_px,
        settings.sigma_common_px,
        # What an edge of reflectance does is compensated, what one of range does is not.
        0.5 * CLIPPED if settings.reflectance_compensation == "on" else CLIPPED,
    )  # fmt: skip
    planes = 2 if settings.returns == "all" else 1
    size = _OUTPUT_PROFILES * planes * columns
    return binning.Assembly(
        columns=Columns(
            packed=np.empty(columns * stride, np.uint32),
            starts=np.arange(columns) * stride,
            counts=np.zeros(columns, np.uint32),
            seeds=np.full(columns, -1, np.int64),
        ),
        estimator=Estimator(
            method=method,
            returns=returns,
            seeded=True,
            events_min=settings.events_min,
            rows=model.rows,
            half_max=half_max,
            line_variance=OWN_PER_WIDTH2 * settings.line_width_px**2,
            noise=noise,
        ),
        smoothing=Smoothing(
            half_width=settings.smoothing_half_width,
            gate_px=float(settings.smoothing_gate_px),
            isolation_gate_px=float(settings.isolation_gate_px),
            isolation_events=settings.isolation_events,
            isolated=np.zeros((planes, columns), np.bool_),
            row=np.zeros((planes, columns)),
            sigma2=np.zeros((planes, columns)),
        ),
        rows=empty_rows(planes, columns),
        scratch=Scratch(np.zeros(1 << ROW_BITS, np.int64), np.empty(likelihood_size(half_max))),
        points=binning.Points(
            *np.empty((3, size), np.int64),
            np.empty(size, np.uint16),
            *np.empty((3, size)),
            np.empty(size, np.uint32),
            np.empty(size, np.uint8),
        ),
    )
