"""Faults of the generator model, as switches."""

from __future__ import annotations


class AwgFaults:
    """Switches of faults; a count runs down to 0 with each time its fault strikes.

    Public attributes:
    - ``lost_replies``: Replies that never arrive.
    - ``late_replies``: Replies that arrive one request late: the next request gets them, unless
      cleared before.
    - ``wrong_tags``, ``wrong_kinds``, ``short_headers``, ``oversized``, ``empty_packets``: Reply
      transfers with a wrong bTag, a wrong MsgID, fewer than 12 bytes, a TransferSize above what
      follows, an empty packet before them.
    - ``transfer_bytes``: Cut replies into transfers of this size without EOM; 0 = uncut.
    - ``newline``: End replies with a newline.
    - ``pending_clears``: CHECK_CLEAR replies "pending" this often.
    - ``no_clear``: INITIATE_CLEAR stalls, as an unsupported request does.
    - ``ignored``: Paths (long form, such as ``BASE:FREQuency``) whose settings have no effect.
    - ``changed``: Path to the text that is set instead of the requested one.
    """

    def __init__(self) -> None:
        self.lost_replies = 0
        self.late_replies = 0
        self.wrong_tags = 0
        self.wrong_kinds = 0
        self.short_headers = 0
        self.oversized = 0
        self.empty_packets = 0
        self.transfer_bytes = 0
        self.newline = False
        self.pending_clears = 0
        self.no_clear = False
        self.ignored: set[str] = set()
        self.changed: dict[str, str] = {}

    def take(self, name: str) -> bool:
        """Return whether fault ``name`` strikes now; counts it."""
        left = getattr(self, name)
        if left > 0:
            setattr(self, name, left - 1)
        return bool(left > 0)
