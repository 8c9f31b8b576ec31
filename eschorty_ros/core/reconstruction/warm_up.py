"""Compiling the kernels before data arrive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from eschorty_ros.core.base.kernel import load_kernels
from eschorty_ros.core.evt3 import Decoder, Encoder
from eschorty_ros.core.evt3.cuts import Cut, next_cut, triggers_of
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration
from eschorty_ros.core.reconstruction.profiles import place
from eschorty_ros.core.reconstruction.reconstructor import Reconstructor
from eschorty_ros.core.reconstruction.settings import Settings


def warm_up(calibration: Calibration, settings: Settings | None = None) -> None:
    """Run a few events through a separate reconstruction.

    The first run on a machine compiles for some minutes; later runs load numba's cache. A node
    does this before it accepts data, which would pile up meanwhile; a command before it measures
    the time.

    - ``settings``: Filter and estimator to compile.
    """
    periods, columns, events = 4, 8, 6
    modulation = Modulation(1000.0, on_edge_us=0)
    t, column, event = np.meshgrid(
        np.arange(periods) * 1000 + 100, np.arange(columns), np.arange(events), indexing="ij"
    )
    row = calibration.rows // 2 + event
    encoder = Encoder(calibration.columns, calibration.rows)
    data = encoder.encode(t.ravel(), column.ravel(), row.ravel(), np.ones(t.size, np.uint8))
    settings = replace(settings or Settings(), periods_per_profile=1)
    reconstructor = Reconstructor(calibration, modulation, settings)
    # With the first piece the phase is known, and the second is decoded straight into columns.
    for piece in (data[: len(data) // 2], data[len(data) // 2 :]):
        reconstructor.push(piece)
    place(reconstructor.flush(), reconstructor.model, 0.0, calibration.stage_direction)
    decoder = Decoder(calibration.columns, calibration.rows)
    words = decoder.words(data)
    next_cut(words, Cut(0, 0), np.zeros(1, np.int64), 1, False, decoder)
    triggers_of(words, decoder)
    load_kernels()
