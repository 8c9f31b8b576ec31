"""Speed of EVT3 decoding against other decoders, on noise and on a laser line.

Run ``python benchmark/decode.py`` after ``pip install -r benchmark/requirements.txt``. One
thread, process CPU time, best of the repeats; the decoders alternate, so that all run under the
same load. ``correct`` compares the count and plain and position-weighted sums with the events
that were encoded.

``sparse`` is uniform noise at 10 Mev/s (ADDR_X words only), ``line`` a four-row laser line in
vector triples with 1.5 % noise.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "test" / "support")]

from streams import line_row_events, sparse_events  # noqa: E402

from eschorty_ros.core import evt3  # noqa: E402
from eschorty_ros.core.evt3 import ActivityFilter  # noqa: E402
from eschorty_ros.core.storage.raw_file import RawReader, RawWriter  # noqa: E402
from eschorty_ros.report.provenance import cpu_model  # noqa: E402

PIECE_BYTES = 128 * 1024
SEED = 20_240_601
TARGETS = {"sparse": 150, "line": 350}

Batch = tuple[Any, Any, Any, Any]


def pieces(path: Path) -> list[bytes]:
    """Return the stream in memory, in pieces as from a driver."""
    return list(RawReader(path).chunks(PIECE_BYTES))


def ours(data: list[bytes]) -> Iterator[Batch]:
    """This package."""
    decoder = evt3.Decoder()
    for piece in data:
        events = decoder.decode(piece)
        yield events.t, events.x, events.y, events.p


def ours_filtered(data: list[bytes]) -> Iterator[Batch]:
    """This package, with the activity filter behind the decoder."""
    decoder, activity = evt3.Decoder(), ActivityFilter()
    for piece in data:
        events = activity.filter(decoder.decode(piece))
        yield events.t, events.x, events.y, events.p


def rust_evt3(data: list[bytes]) -> Iterator[Batch]:
    """The ``evt3`` package (Rust)."""
    import evt3 as peer

    decoder = peer.Decoder()
    for piece in data:
        events = decoder.feed(piece)
        yield events.timestamp, events.x, events.y, events.polarity


def evutils_native(data: list[bytes]) -> Iterator[Batch]:
    """The ``evutils`` C parser on reused buffers; unused words are passed again."""
    from evutils.io._native_core import EventSoABuffers, TriggerSoABuffers
    from evutils.io._native_evt import Evt3Input, Evt3Parser

    count = PIECE_BYTES // 2
    words = np.frombuffer(b"".join(data) + bytes(16), dtype=np.uint16)
    parser = Evt3Parser()
    events, triggers = EventSoABuffers(12 * count), TriggerSoABuffers(count)
    at = 0
    while at < words.size:
        events.reset()
        triggers.reset()
        window = Evt3Input(words[at : at + count])
        used = window.consumed(parser.parse_chunk_soa(window, events, triggers))
        if used == 0:
            break
        at += used
        yield events.view()


def expelliarmus_chunks(path: Path) -> Iterator[Batch]:
    """The ``expelliarmus`` C decoder, which reads the file itself."""
    from expelliarmus import Wizard

    wizard = Wizard(encoding="evt3", fpath=path, chunk_size=262_144)
    for events in wizard.read_chunk():
        yield events["t"], events["x"], events["y"], events["p"]


def sums(batches: Iterator[Batch]) -> list[int]:
    """Return count, sums, and sums weighted by position (modulo 2**64)."""
    totals = [0] * 9
    with np.errstate(over="ignore"):
        for batch in batches:
            arrays = [np.asarray(values).astype(np.uint64) for values in batch]
            place = np.arange(totals[0], totals[0] + arrays[0].size, dtype=np.uint64)
            totals[0] += arrays[0].size
            for k, values in enumerate(arrays):
                totals[1 + k] += int(values.sum())
                totals[5 + k] = (totals[5 + k] + int((values * place).sum())) % 2**64
    return totals


def seconds(batches: Callable[[], Iterator[Batch]]) -> float:
    """Return the CPU time to exhaust the iterator."""
    began = time.process_time()
    for _ in batches():
        pass
    return time.process_time() - began


def version(package: str) -> str | None:
    """Return the installed version, ``None`` when absent."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def measure(name: str, events: Batch, path: Path, repeats: int) -> bool:
    """Print the rows of one stream; return true when ours is right and the fastest."""
    with RawWriter(path) as writer:
        writer.write(evt3.Encoder().encode(*events))
    data = pieces(path)
    size_mb = sum(map(len, data)) / 1e6
    count = len(events[0])
    rows: dict[str, Callable[[], Iterator[Batch]]] = {"eschorty_ros": lambda: ours(data)}
    for package, run in (("evt3", rust_evt3), ("evutils", evutils_native)):
        if version(package):
            rows[package] = lambda run=run: run(data)  # type: ignore[misc]
    if version("expelliarmus"):
        rows["expelliarmus"] = lambda: expelliarmus_chunks(path)
    rows["ours + activity filter"] = lambda: ours_filtered(data)
    truth = sums(iter([events]))
    right = {label: sums(run()) == truth for label, run in rows.items()}
    best = dict.fromkeys(rows, float("inf"))
    for _ in range(repeats):
        for label, run in rows.items():
            best[label] = min(best[label], seconds(run))
    print(
        f"\n{name}: {count / 1e6:.1f} M events, {size_mb:.1f} MB, "
        f"{1e6 * size_mb / count:.3f} B/event"
    )
    print(f"{'decoder':24} {'Mev/s':>8} {'MB/s':>8} {'correct':>8} {'ours / it':>10}")
    for label, spent in best.items():
        verdict = "-" if "filter" in label else ("yes" if right[label] else "NO")
        ratio = spent / best["eschorty_ros"]
        print(
            f"{label:24} {count / spent / 1e6:8.1f} {size_mb / spent:8.1f} {verdict:>8} "
            f"{ratio:10.2f}"
        )
    return right["eschorty_ros"] and best["eschorty_ros"] == min(best.values())


def main() -> int:
    """Measure both streams; exit status 1 when ours is wrong or not the fastest."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=20_000_000, help="events in each stream")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    names = ("numpy", "numba", "evt3", "evutils", "expelliarmus")
    print(
        f"CPU: {cpu_model()}; Python {platform.python_version()}; "
        + "; ".join(
            f"{name} {version(name) or 'absent (pip install -r benchmark/requirements.txt)'}"
            for name in names
        )
    )
    print(f"seed {SEED}; at least {TARGETS} Mev/s per core of a 2.5 GHz Xeon expected")
    rng = np.random.default_rng(SEED)
    fine = True
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stream.raw"
        for name, make in (("sparse", sparse_events), ("line", line_row_events)):
            events = evt3.sort_readout(*make(rng, arguments.events))
            fine &= measure(name, events, path, arguments.repeats)
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
