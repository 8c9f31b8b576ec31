"""The smallest device on the emulated bus: it returns what it receives."""

from eschorty_ros.emulation.bus import EmulatedUsbDevice, EndpointIdentity, UsbIdentity

OUT, IN = 0x02, 0x82
PACKET = 64
IDENTITY = UsbIdentity(
    0x1234,
    0x5678,
    interface_class=0xFF,
    interface_subclass=0x19,
    interface_protocol=0,
    endpoints=(EndpointIdentity(OUT, PACKET), EndpointIdentity(IN, PACKET)),
    serial="LOOP1",
    manufacturer="maker",
    product="loop",
)


class Loop(EmulatedUsbDevice):
    """Returns every transfer; ends one of full packets with an empty one if ``zero_length``."""

    def __init__(self, identity=IDENTITY, *, zero_length=True, wait=lambda *_: False):
        super().__init__(identity, wait=wait)
        self.zero_length = zero_length

    def bulk_out(self, endpoint, data, timeout_ms):
        self.reply(IN, data, zero_length=self.zero_length and len(data) % PACKET == 0)
        return len(data)
