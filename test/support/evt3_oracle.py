"""A slow EVT3 decoder in plain Python, written from the format and not from the kernels."""

from collections import Counter


class SlowDecoder:
    """One word at a time; ``events`` and ``triggers`` are lists of tuples, ``counts`` a Counter."""

    def __init__(self, width: int = 1280, height: int = 720) -> None:
        self.width, self.height = width, height
        self.events: list[tuple[int, int, int, int]] = []
        self.triggers: list[tuple[int, int, int]] = []
        self.counts: Counter[str] = Counter()
        self.high: int | None = None
        self.wrapped = self.low = self.newest = 0
        self.waiting: list[int] | None = None
        self.bad_before = 0
        self.row: int | None = None
        self.base: int | None = None
        self.polarity = 0
        self.in_triple = 0
        self.other: tuple[int, list[int]] | None = None

    @property
    def now(self) -> int:
        return max(self.newest, self.wrapped + (self.high or 0) * 4096 + self.low)

    @property
    def bad_words(self) -> int:
        names = "unknown_words", "legacy_y_words", "broken_triples", "broken_continuations"
        return sum(self.counts[name] for name in names)

    def feed(self, words: list[int]) -> None:
        for word in words:
            self.word(word >> 12, word & 0xFFF)

    def word(self, kind: int, q: int) -> None:
        if self.high is None and kind != 8:
            self.counts["words_before_time"] += 1
            pixels = {2: 1, 4: bin(q).count("1"), 5: bin(q & 255).count("1")}.get(kind, 0)
            self.lose("events_before_time", pixels)
            return
        if self.in_triple and kind != (4, 4, 5)[self.in_triple]:
            self.counts["broken_triples"] += 1
            self.in_triple = 0
        if self.other is not None and self.continuation(kind, q):
            return
        if kind == 0:
            self.row = q & 2047
            self.counts["y_past_height"] += self.row >= self.height
        elif kind == 1:
            self.row = None
            self.counts["legacy_y_words"] += 1
        elif kind == 2:
            self.pixels([q & 2047], q >> 11)
        elif kind == 3:
            self.base, self.polarity = q & 2047, q >> 11
        elif kind in (4, 5):
            self.vector(kind, q)
        elif kind == 6:
            self.low = q
            self.counts["time_low_back"] += self.wrapped + self.high * 4096 + q < self.newest
        elif kind == 8:
            self.time_high(q)
        elif kind == 10:
            self.newest = self.now
            self.triggers.append((self.now, q >> 8, q & 1))
            self.counts["triggers"] += 1
        elif kind == 14:
            self.counts["others_words"] += 1
            name = {0xED6: "time_low", 0xED8: "time_high", 0xEDA: "events"}.get(q)
            if name:
                self.counts["sensor_dropped_" + name] += 1
            self.other = (q, [])
        elif kind in (7, 15):
            self.counts["broken_continuations"] += 1
        else:
            self.counts["unknown_words"] += 1

    def lose(self, why: str, count: int) -> None:
        self.counts[why] += count
        self.counts["events_dropped"] += count

    def pixels(self, columns: list[int], polarity: int) -> int:
        """Emit; returns how many lay past the width."""
        if self.row is None or self.row >= self.height:
            self.counts["x_without_y"] += self.row is None
            self.lose("events_without_y", len(columns))
            return 0
        inside = [x for x in columns if x < self.width]
        if inside:
            self.newest = self.now
        self.events += [(self.now, x, self.row, polarity) for x in inside]
        self.counts["events"] += len(inside)
        self.lose("events_past_width", len(columns) - len(inside))
        return len(columns) - len(inside)

    def vector(self, kind: int, q: int) -> None:
        """Words of type 4 and 5."""
        bits = 12 if kind == 4 else 8
        if kind == 5 and self.in_triple != 2:
            self.counts["broken_triples"] += 1
        self.in_triple = 0 if kind == 5 else self.in_triple + 1
        offsets = [k for k in range(bits) if q >> k & 1]
        if self.base is None:
            self.counts["vectors_without_base"] += 1
            self.lose("events_without_base", len(offsets))
            return
        past = self.pixels([self.base + k for k in offsets], self.polarity)
        self.counts["vectors_past_width"] += past > 0
        self.base += bits

    def continuation(self, kind: int, q: int) -> bool:
        """Return whether the word belonged to the pending OTHERS."""
        subtype, parts = self.other
        if kind == 15 and len(parts) < 2:
            parts.append(q)
            return True
        complete = kind == 7 and len(parts) == 2
        if complete:
            parts.append(q & 15)
        elif kind in (7, 15) or parts:
            self.counts["broken_continuations"] += 1
        payload = sum(part << 12 * k for k, part in enumerate(parts))
        name = {0x014: "erc_events_in", 0x016: "erc_events_out"}.get(subtype)
        if name:
            self.counts[name] += payload
        self.other = None
        return kind in (7, 15)

    def move(self, q: int) -> None:
        """Take a TIME_HIGH that is not a plain step forward."""
        step = q - self.high
        if step < -2048:
            self.wrapped += 1 << 24
            step += 4096
        if step < 0:
            self.counts["time_high_back"] += 1
        elif step > 3:
            self.counts["time_high_jumps"] += 1
        self.high = q

    def time_high(self, q: int) -> None:
        """Section on time: wrap, clamp, hold."""
        if self.high is None:
            self.high = q
            return
        waiting, self.waiting = self.waiting, None
        ahead = (q - self.high) % 4096
        if ahead <= 3:
            self.counts["time_high_dropped"] += waiting is not None
            if ahead:
                self.wrapped += (1 << 24) * (q < self.high)
                self.high, self.low = q, 0
        elif (
            waiting is not None
            and (q - waiting[-1]) % 4096 <= 25
            and self.bad_words == self.bad_before
        ):
            self.low *= q == waiting[-1]
            self.waiting = [*waiting, q]
            if len(self.waiting) == 3:
                self.move(q)
                self.waiting = None
        else:
            self.counts["time_high_dropped"] += waiting is not None
            if ahead >= 4093:
                self.counts["time_high_back"] += 1
                self.wrapped -= (1 << 24) * (q > self.high)
                self.high = q
            else:
                self.waiting, self.bad_before = [q], self.bad_words
            self.low = 0
