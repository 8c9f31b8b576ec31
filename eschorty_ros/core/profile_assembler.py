"""Columns of the open period and the points of the closed ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core import _binning as binning
from eschorty_ros.core import _window_kernels as windows
from eschorty_ros.core._checks import exact, whole
from eschorty_ros.core._row_kernels import likelihood_size
from eschorty_ros.core.centroid import check_method, half_width_fixed
from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.phase_gate import gate_parameters
from eschorty_ros.core.profiles import LineRows
from eschorty_ros.core.row_sigma import CLIPPED, OWN_PER_WIDTH2, noise_of
from eschorty_ros.core.settings import Settings

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
        if model.rows > windows.ROW_LAST + 1:
            raise ArgumentError(
                f"rows is {model.rows}; the reconstruction takes {windows.ROW_LAST + 1} at most"
            )
        self._done: list[LineRows] = []
        self._half_max = half_width_fixed(settings.line_width_px)
        self._gate_us = settings.phase_gate_us
        self._counts = np.zeros(len(binning.COUNTERS), dtype=np.int64)
        columns = model.columns
        self._lists = np.empty(columns * (settings.column_limit + windows.BLOCK), dtype=np.uint32)
        self._column_counts = np.zeros(columns, dtype=np.uint32)
        self._seeds = np.full(columns, -1, dtype=np.int64)
        self._state = np.zeros(binning.S_SIZE, dtype=np.int64)
        planes = 2 if settings.returns == "all" else 1
        self._work = np.zeros((binning.W_SIZE, planes, columns))
        self._work_int = np.zeros((binning.N_SIZE, planes, columns), dtype=np.int64)
        self._scratch = np.zeros(1 << windows.ROW_BITS, dtype=np.int64)
        self._likelihood = np.empty(likelihood_size(self._half_max))
        self._whole, self._fractional = _parameters(settings, model.rows)
        self._noise = noise_of(
            settings.centroid, settings.sigma_factor, settings.sigma_floor_px,
            settings.sigma_common_px,
            # What an edge of reflectance does is compensated, what one of range does is not.
            0.5 * CLIPPED if settings.reflectance_compensation == "on" else CLIPPED,
        )  # fmt: skip
        size = _OUTPUT_PROFILES * planes * columns
        self._whole_out = np.empty((3, size), dtype=np.int64)
        self._column_out = np.empty(size, dtype=np.uint16)
        self._row_out = np.empty((3, size))
        self._events_out = np.empty(size, dtype=np.uint32)
        self._return_out = np.empty(size, dtype=np.uint8)

    def restart(self, modulation: Modulation) -> None:
        """Forget the open period, the seeds and the line's width; gate by ``modulation``."""
        self._gate = gate_parameters(modulation, self._gate_us)
        self._state[binning.S_OPEN] = 0
        self._state[binning.S_HALF] = self._half_max
        self._column_counts[:] = 0
        self._seeds[:] = -1

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name."""
        return dict(zip(binning.COUNTERS, self._counts.tolist(), strict=True))

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
        out = (
            *self._whole_out, self._column_out, *self._row_out, self._events_out, self._return_out,
        )  # fmt: skip
        stop = exact("t", t, np.int64).size
        t, x = np.ascontiguousarray(t), exact("x", x, np.uint16, stop)
        y, p = exact("y", y, np.uint16, stop), exact("p", p, np.uint8, stop)
        edges = exact("edges", edges, np.int64)
        indices = exact("indices", indices, np.int64, edges.size)
        first, edge = 0, whole("first_edge", first_edge, 0, edges.size)
        while True:
            first, edge = binning._bin(
                t, x, y, p, first, stop, edges, indices, edge, len(edges), drain, self._gate,
                self._lists, self._column_counts, self._seeds, self._state, self._whole,
                self._fractional, self._noise, self._work, self._work_int, self._scratch,
                self._likelihood, self._counts, out,
            )  # fmt: skip
            if first == stop and (edge == len(edges) or not drain):
                return int(edge)
            self._collect()

    def close(self) -> None:
        """Close the open period if it holds events; it stays open for further ones."""
        if self._state[binning.S_OPEN] == 2:
            none = np.empty(0, dtype=np.int64)
            nowhere = np.empty(0, dtype=np.uint16)
            edge, index = self._state[[binning.S_EDGE]], self._state[[binning.S_INDEX]]
            self.merge(none, nowhere, nowhere, np.empty(0, dtype=np.uint8), edge, index, 0, True)

    def take(self) -> LineRows:
        """Rows of the periods closed since the last call."""
        self._collect()
        done, self._done = self._done, []
        return done[0] if len(done) == 1 else LineRows.concatenate(done)

    def _collect(self) -> None:
        """Copy the output buffer's rows and empty it."""
        n = int(self._state[binning.S_POINTS])
        self._state[binning.S_POINTS] = 0
        if n == 0:
            return
        period, edge, t_us = self._whole_out[:, :n].copy()
        row, sigma, width = self._row_out[:, :n].copy()
        self._done.append(
            LineRows(
                period=period,
                edge_us=edge,
                t_us=t_us,
                column=self._column_out[:n].copy(),
                row=row,
                sigma_row=sigma,
                events=self._events_out[:n].copy(),
                width_px=width,
                return_index=self._return_out[:n].copy(),
            )
        )


def _parameters(settings: Settings, rows: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    whole = np.zeros(binning.P_SIZE, dtype=np.int64)
    whole[binning.P_METHOD], whole[binning.P_RETURNS] = check_method(
        settings.centroid, settings.returns
    )
    whole[binning.P_EVENTS_MIN] = settings.events_min
    whole[binning.P_HALF_MAX] = half_width_fixed(settings.line_width_px)
    whole[binning.P_ROWS] = rows
    whole[binning.P_SMOOTH] = settings.smoothing_half_width
    whole[binning.P_WEAK] = settings.isolation_events
    fractional = np.zeros(binning.F_SIZE)
    fractional[binning.F_OWN] = OWN_PER_WIDTH2 * settings.line_width_px**2
    fractional[binning.F_GATE] = settings.smoothing_gate_px
    fractional[binning.F_ISOLATION] = settings.isolation_gate_px
    return whole, fractional
