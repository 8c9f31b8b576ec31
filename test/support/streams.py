"""Generated EVT3 streams whose content is known."""

import numpy as np
from numpy.typing import NDArray

Vectors = tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]

RECORDING_SHARES = {0: 0.1930, 2: 0.6394, 3: 0.0341, 4: 0.0687, 5: 0.0344, 6: 0.0285, 8: 0.0018}
"""Shares of the word types in a real Gen4.1 recording: hand-held scene, 25 Mev/s."""


def words_of(text: str) -> bytes:
    """Bytes of hexadecimal words separated by blanks."""
    return np.array([int(word, 16) for word in text.split()], dtype="<u2").tobytes()


def recording_like_words(rng: np.random.Generator, time_steps: int) -> list[int]:
    """A stream with the word mix and rhythm of the real recording.

    TIME_LOW every us or so with about 35 words between, TIME_HIGH repeated every 16 TIME_LOW,
    a corrected TIME_LOW now and then, rows with one to a few ADDR_X, some with a vector triple.
    """
    words = []
    t = int(rng.integers(4000, 4095)) << 12 | 0xF00
    for step in range(time_steps):
        t += int(rng.integers(1, 3))
        if step % 16 == 0:
            words.append(0x8000 | t >> 12 & 0xFFF)
            if rng.random() < 0.1:
                words.append(0x6000 | t + 11 & 0xFFF)
        elif t & 0xFFF in (0, 1):
            words.append(0x8000 | t >> 12 & 0xFFF)
        words.append(0x6000 | t & 0xFFF)
        for _ in range(rng.poisson(6.8)):
            words.append(int(rng.integers(0, 720)))
            words += [0x2000 | int(q) for q in rng.integers(0, 1280, rng.poisson(3.3))]
            if rng.random() < 0.17:
                base, polarity = int(rng.integers(0, 1248)), int(rng.integers(0, 2))
                words.append(0x3000 | polarity << 11 | base)
                masks = [int(q) for q in rng.integers(0, 4096, 3)]
                words += [0x4000 | masks[0], 0x4000 | masks[1], 0x5000 | masks[2] & 0xFF]
    return words


def sparse_events(rng: np.random.Generator, count: int) -> Vectors:
    """Uniform noise of 10 events per microsecond."""
    return (
        np.sort(rng.integers(0, max(count // 10, 1), count)),
        rng.integers(0, 1280, count).astype(np.uint16),
        rng.integers(0, 720, count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
    )


def line_row_events(rng: np.random.Generator, count: int) -> Vectors:
    """A laser line of four rows, read out row by row, with 1.5 % noise; not sorted yet."""
    flashes = count // 3500 + 1
    flash, pixel = np.nonzero(rng.random((flashes, 4 * 1280)) < 0.7)
    first_row = rng.integers(100, 600, flashes)
    noise = int(0.015 * flash.size)
    t = np.concatenate([flash * 5000 + pixel // 1280, rng.integers(0, flashes * 5000, noise)])
    x = np.concatenate([pixel % 1280, rng.integers(0, 1280, noise)])
    y = np.concatenate([first_row[flash] + pixel // 1280, rng.integers(0, 720, noise)])
    p = np.concatenate([flash % 2, rng.integers(0, 2, noise)])
    return t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8)
