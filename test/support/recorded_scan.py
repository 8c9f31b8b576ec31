"""A scan through the live pipeline with a recorder, from a simulated camera and stage.

``python recorded_scan.py SOURCE FOLDER``: the process is killed in the middle of the sweep.
"""

import os
import signal
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Settings
from eschorty_ros.core.storage import ScanLog, load_recording
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.live.packet_times import Packet
from eschorty_ros.live.pipeline import Pipeline
from eschorty_ros.live.scan_recorder import ScanRecorder
from eschorty_ros.simulation.scenes import named
from eschorty_ros.simulation.world import simulate_recording

SEED = 5
ZERO_NS = 1_760_000_000_000_000_000
BEGIN_US, LASER_US = 30_000, 50_000
SETTINGS = Settings(smoothing_half_width=3, trigger_source="none")
PACKET_BYTES = 1500
LIMITS_MM = 11.0, 19.0
SPEED_MM_S = 50.0


def source(folder):
    """Simulate what camera and stage send: 64 columns, 10 mm at 50 mm/s."""
    small = replace(load_calibration("config_3"), columns=64, principal_column=None)
    return simulate_recording(
        folder, named("tilted"), small, start_mm=10.0, stop_mm=20.0, seed=SEED
    )


class LiveScan:
    """Packets with late stamps, seq from 7 on; those of ``lost`` are missing."""

    def __init__(self, recording, folder, lost=(), settings=SETTINGS, **options):
        start_mm, stop_mm = LIMITS_MM
        log = ScanLog(
            scan_id="s", start_mm=start_mm, stop_mm=stop_mm, speed_mm_s=SPEED_MM_S, stage_gap_s=0.5
        )
        build = recording.calibration
        self.recorder = ScanRecorder(folder, log, build, asdict(settings), **options)
        assert self.recorder.made(5.0) == ""
        self.pipeline = Pipeline(build, settings, 0.0, 0.5, 6.0)
        self.pipeline.stream.announcement_expected = False
        self.modulation = Modulation(70.0)
        self.packets = []
        rng, decoder, stamp_ns = np.random.default_rng(SEED), Decoder(64, 720), 0
        for seq, data in enumerate(RawReader(recording.events_path).chunks(PACKET_BYTES), 7):
            decoder.decode(data)
            late_ns = int(rng.integers(0, 2_000_000))
            stamp_ns = max(stamp_ns, ZERO_NS + decoder.time_us * 1000 + late_ns)
            if seq not in lost:
                self.packets.append((decoder.time_us, Packet(seq, stamp_ns, data)))
        self.samples = recording.stage_samples.tolist()

    def run(self, until_us=1 << 60, reason="", later=()):
        """Feed what comes before ``until_us``; return the scan's report, or None before its end.

        ``later`` are states of the laser after its start: since when (us), modulation, whether on.

        As in the node, up to three packets wait for each other, and what happens between two
        packets takes effect there.
        """
        pipeline, begun, row, now_s = self.pipeline, False, 0, 0.0
        states = [(LASER_US, self.modulation, True), *later]
        pipeline.stream.set_laser(self.modulation, None)
        for index, (t_us, packet) in enumerate(self.packets):
            if t_us > until_us:
                pipeline.process(now_s)
                return None
            now_s = t_us * 1e-6
            while row < len(self.samples) and self.samples[row][0] <= t_us:
                pipeline.add_stage(ZERO_NS + self.samples[row][0] * 1000, self.samples[row][1])
                row += 1
            if not begun and t_us > BEGIN_US:
                begun = True
                pipeline.process(now_s)
                pipeline.begin_scan("s", *LIMITS_MM, self.recorder, speed_mm_s=SPEED_MM_S)
            while states and t_us > states[0][0]:
                since_us, modulation, on = states.pop(0)
                pipeline.process(now_s)
                on_ns = ZERO_NS + since_us * 1000 if on else None
                pipeline.stream.set_laser(modulation, None, on_ns)
            pipeline.add_packet(packet, now_s)
            if index % 3 == 2:
                pipeline.complete(now_s)
                pipeline.place(now_s)
        pipeline.complete(now_s)
        pipeline.place(now_s)
        for t_us, position_mm in self.samples[row:]:
            pipeline.add_stage(ZERO_NS + t_us * 1000, position_mm)
        pipeline.close_period("s", now_s)
        pipeline.complete(now_s + 1.0)
        pipeline.place(now_s + 1.0)
        return pipeline.end_scan(reason)


if __name__ == "__main__":
    origin, target = map(Path, sys.argv[1:])
    scan = LiveScan(load_recording(origin), target)
    scan.run(until_us=220_000)
    wanted = sum(len(packet.data) for t_us, packet in scan.packets if BEGIN_US < t_us <= 220_000)
    events = target / "events.raw"
    while not events.exists() or events.stat().st_size < wanted:
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGKILL)
