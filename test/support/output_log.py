"""The log of the emulated generator."""

from pathlib import Path


def read_output_log(log_path: str | Path) -> list[tuple[int, str]]:
    """Return the lines of a log: monotonic ns and ON or OFF, in order."""
    lines = Path(log_path).read_text(encoding="ascii").splitlines()
    return [(int(t_ns), state) for t_ns, state in (line.split() for line in lines)]
