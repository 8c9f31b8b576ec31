"""The faults a plan can name, by device: what each does to the model, and how it ends.

The ids are those of the fault list the drivers are built to; several names may belong to one id.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Action = Callable[[Any, "Dose"], None]


@dataclass(frozen=True, slots=True)
class Dose:
    """How much of a fault: a count or size, what it is about, and when it happens."""

    amount: int = 1
    target: str = ""
    now_ns: int = 0


@dataclass(frozen=True, slots=True)
class Kind:
    """A fault by name.

    Parameters
    ----------
    id : str
        Its number in the list of faults.
    begin : callable
        Called with the model and the dose.
    end : callable or None
        Takes it back; None for faults that end by themselves.
    means : str
        One line for the reader of the docs.
    needs_target : bool
    """

    id: str
    begin: Action
    end: Action | None
    means: str
    needs_target: bool = False


def _set(name: str, value: Any, back: Any) -> tuple[Action, Action]:
    return (
        lambda model, dose: setattr(model, name, value),
        lambda model, dose: setattr(model, name, back),
    )


def _stall(*endpoints: int) -> tuple[Action, Action]:
    return (
        lambda model, dose: model.stalled.update(endpoints),
        lambda model, dose: model.stalled.difference_update(endpoints),
    )


def _count(part: str, name: str) -> Action:
    """Let that many of the next go wrong."""

    def begin(model: Any, dose: Dose) -> None:
        owner = getattr(model, part) if part else model
        setattr(owner, name, dose.amount)

    return begin


def _usb(out: int, back: int) -> dict[str, Kind]:
    return {
        "unplug": Kind(
            "U1",
            lambda model, dose: setattr(model, "gone", True),
            lambda model, dose: model.replug(),
            "unplugged; plugged in again, at another address, when it ends",
        ),
        "stall": Kind("U2", *_stall(out, back), "both command endpoints stall until cleared"),
        "mute": Kind("U3", *_set("mute", True, False), "every transfer times out"),
        "denied": Kind("U10", *_set("denied", True, False), "opening is not permitted"),
    }


def _empty_packets(model: Any, dose: Dose) -> None:
    for _ in range(dose.amount):
        model.reply(0x81, b"")


_CAMERA = {
    **_usb(0x02, 0x82),
    "stall_data": Kind("U2", *_stall(0x81), "the data endpoint stalls until cleared"),
    "lost_answers": Kind("U3", _count("answer_faults", "lost"), None, "answers that never come"),
    "short_answers": Kind("U4", _count("answer_faults", "short"), None, "answers of 6 bytes"),
    "garbled_answers": Kind(
        "U4", _count("answer_faults", "garbled"), None, "answers to another request"
    ),
    "empty_packets": Kind("U4", _empty_packets, None, "empty packets among the events"),
    "cut_packets": Kind("U4", _count("", "cut_packets"), None, "event packets less a byte"),
    "doubled_answers": Kind("U6", _count("answer_faults", "doubled"), None, "answers come twice"),
    "stale_data": Kind(
        "U6", lambda model, dose: model.stale(b"\x01\x20" * dose.amount), None, "events of no start"
    ),
    "overflow": Kind(
        "X1",
        lambda model, dose: setattr(model, "buffer_bytes", dose.amount),
        lambda model, dose: setattr(model, "buffer_bytes", None),
        "the camera holds only so many bytes for a late host, and marks what it drops",
    ),
    "reboot": Kind("U9", lambda model, dose: model.power_up(), None, "settings are gone"),
}


def _error_queue(model: Any, dose: Dose) -> None:
    text = dose.target or '-113,"Undefined header"'
    model.errors = type(model.commands)([text] * dose.amount)


def _change(model: Any, dose: Dose) -> None:
    path, _, text = dose.target.partition("=")
    model.faults.changed[path] = text


def _touch(model: Any, dose: Dose) -> None:
    path, _, text = dose.target.partition("=")
    model.touch(path, text)


_LASER = {
    **_usb(0x01, 0x81),
    "lost_replies": Kind("U3", _count("faults", "lost_replies"), None, "replies never come"),
    "wrong_tags": Kind("U4", _count("faults", "wrong_tags"), None, "replies with another bTag"),
    "wrong_kinds": Kind("U4", _count("faults", "wrong_kinds"), None, "replies of another MsgID"),
    "short_headers": Kind("U4", _count("faults", "short_headers"), None, "replies of 7 bytes"),
    "oversized": Kind("U4", _count("faults", "oversized"), None, "replies shorter than they say"),
    "empty_packets": Kind("U4", _count("faults", "empty_packets"), None, "an empty packet first"),
    "split_replies": Kind(
        "U5",
        _count("faults", "transfer_bytes"),
        lambda model, dose: setattr(model.faults, "transfer_bytes", 0),
        "replies in transfers of so many bytes, EOM on the last",
    ),
    "newlines": Kind(
        "U5",
        lambda model, dose: setattr(model.faults, "newline", True),
        lambda model, dose: setattr(model.faults, "newline", False),
        "replies end in a newline",
    ),
    "late_replies": Kind("U6", _count("faults", "late_replies"), None, "replies a request late"),
    "errors": Kind("U7", _error_queue, None, "an error queue with that many entries of a text"),
    "ignored": Kind(
        "U8",
        lambda model, dose: model.faults.ignored.add(dose.target),
        lambda model, dose: model.faults.ignored.discard(dose.target),
        "a setting, such as BASE:FREQuency, has no effect",
        needs_target=True,
    ),
    "changed": Kind(
        "U8",
        _change,
        lambda model, dose: model.faults.changed.pop(dose.target.partition("=")[0], None),
        "a setting takes another value: BASE:FREQuency=19999",
        needs_target=True,
    ),
    "touched": Kind("U8", _touch, None, "a hand at the panel: OUTPut=OFF", needs_target=True),
    "reboot": Kind("U9", lambda model, dose: model.reboot(), None, "restarts, settings are gone"),
    "kernel_driver": Kind(
        "U10",
        lambda model, dose: setattr(model, "kernel_driver", dose.target or "usbtmc"),
        lambda model, dose: setattr(model, "kernel_driver", None),
        "a kernel driver holds the interface",
    ),
}


def _jump(model: Any, dose: Dose) -> None:
    model.axis.encoder_offset_mm += dose.amount / 1000


def _stall_carriage(model: Any, dose: Dose) -> None:
    model.axis.freeze(dose.now_ns)


def _error_message(model: Any, dose: Dose) -> None:
    model.complain(dose.amount, dose.target)


def _bits(model: Any, dose: Dose) -> None:
    model.extra_bits |= dose.amount


_STAGE = {
    "unplug": Kind("S6", *_set("gone", True, False), "bytes reach neither side"),
    "mute": Kind("S6", *_set("mute", True, False), "it hears and never answers"),
    "garbage": Kind(
        "S1",
        lambda model, dose: setattr(
            model.disturbance, "garbage", struct.pack("B", 0x91) * dose.amount
        ),
        None,
        "so many stray bytes between two frames",
    ),
    "lost_bytes": Kind("S2", _count("disturbance", "lost_bytes"), None, "so many bytes are lost"),
    "flipped_bits": Kind("S3", _count("disturbance", "flips"), None, "a bit flips in each frame"),
    "encoder_jump": Kind("S4", _jump, None, "the encoder jumps by so many micrometres and stays"),
    "stalled": Kind(
        "S5",
        _stall_carriage,
        lambda model, dose: setattr(model.axis, "stalled", False),
        "the carriage stands still while it should move",
    ),
    "status_bits": Kind(
        "S7",
        _bits,
        lambda model, dose: setattr(model, "extra_bits", model.extra_bits & ~dose.amount),
        "status bits on top, such as 1 (forward limit) or 0x4000 (following error)",
    ),
    "withheld": Kind(
        "S8",
        lambda model, dose: model.withheld.add(dose.target),
        lambda model, dose: model.withheld.discard(dose.target),
        "a message, such as moved, is never sent",
        needs_target=True,
    ),
    "disabled": Kind(
        "S10", *_set("panel_disabled", True, False), "it cannot be enabled: disabled at the panel"
    ),
    "ignored_moves": Kind("S10", *_set("ignores_moves", True, False), "moves are not carried out"),
    "error_message": Kind("S11", _error_message, None, "an error message of that code and text"),
    "reboot": Kind("S12", lambda model, dose: model.reboot(), None, "bits cleared, counters 0"),
    "repeated": Kind("S13", _count("disturbance", "repeats"), None, "frames come twice"),
}

CATALOGUE = {"camera": _CAMERA, "laser": _LASER, "stage": _STAGE}


def recognises(device: str, message: str, data: bytes) -> bool:
    """Whether bytes from the host carry a message.

    A message is written ``OUTP`` (part of a command) for the laser, ``2C`` (a register that is
    written, hex) for the camera, ``0453`` (message id, hex) for the stage.
    """
    if device == "laser":
        return message.upper().encode() in data.upper()
    number = int(message, 16)
    if device == "camera":
        return len(data) >= 16 and struct.unpack_from("<4I", data)[::3] == (0x40010102, number)
    return any(struct.pack("<H", number) == data[at : at + 2] for at in range(len(data) - 5))
