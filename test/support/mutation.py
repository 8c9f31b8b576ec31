"""Mutated files: bytes of a valid one, changed in a few places; the same for the same seed."""

import numpy as np

TOKENS = [
    b"&a [*a, *a]", b"*a", b"[" * 3000, b"{a: " * 500, b"!!python/object:os.system ", b"9" * 5000,
    b"0x_", b"0b", b"1e999", b".nan", b"-.inf", b"nan", b"inf", b"1:2:3", b"---\n", b"%YAML 9.9\n",
    b"? ", b"'", b'"\\UFFFFFFFF"', b"\0", b"\xff\xfe", b"\xf0\x9f\x92\xa9", b"\r", b"\t", b"\n\n",
    b"../../etc/passwd", b"{channel:>99999999}", b"(" * 300, b"-1", b"1" * 30, b"<<: ", b"% end\n",
    b",,,", b"|-\n", b"{}", b"[]", b"~", b"true", b"2026-13-45", b"\xe2\x80\xa8", b"x" * 70_000,
]  # fmt: skip


def mutations(data, count, seed):
    """``count`` mutants of ``data``."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        mutant = bytearray(data)
        for _ in range(int(rng.integers(1, 4))):
            _change(mutant, rng)
        yield bytes(mutant)


def _change(mutant, rng):
    at = int(rng.integers(0, len(mutant) + 1))
    end = min(at + int(rng.integers(1, 40)), len(mutant))
    match int(rng.integers(0, 7)):
        case 0:
            mutant[at:end] = rng.bytes(end - at)
        case 1:
            del mutant[at:end]
        case 2:
            del mutant[at:]
        case 3:
            other = int(rng.integers(0, len(mutant) + 1))
            mutant[other:other] = mutant[at:end]
        case 4:
            # A value as a whole: what stands after a colon, a comma or a blank.
            marks = [i + 1 for i, byte in enumerate(mutant[:5000]) if byte in b":, "]
            at = int(rng.choice(marks)) if marks else at
            stop = min((i for i in range(at, len(mutant)) if mutant[i] in b",\n"), default=at)
            mutant[at:stop] = b" " + TOKENS[int(rng.integers(len(TOKENS)))]
        case _:
            mutant[at:at] = TOKENS[int(rng.integers(len(TOKENS)))]
