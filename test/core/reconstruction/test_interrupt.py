"""Ctrl-C at any moment of a reconstruction is an exception, with which the laser goes off."""

import subprocess
import sys

import pytest

SCRIPT = """
import random, signal, sys, time

import numpy as np

import eschorty_ros as es
from eschorty_ros.core.evt3 import Encoder

t_us, column, event = np.meshgrid(
    np.arange(60) * 1000 + 100, np.arange(1280), np.arange(12), indexing="ij"
)
row, polarity = 350 + event % 3, np.ones(t_us.size, int)
data = Encoder().encode(t_us.ravel(), column.ravel(), row.ravel(), polarity)
calibration, modulation = es.load_calibration("config_3"), es.Modulation(1000.0, on_edge_us=0)


def reconstruct():
    reconstructor = es.Reconstructor(calibration, modulation, jobs=int(sys.argv[1]))
    for begin in range(0, len(data), 20_000):
        reconstructor.push(data[begin : begin + 20_000])
    reconstructor.flush()


reconstruct()
begun_s = time.perf_counter()
reconstruct()
duration_s = time.perf_counter() - begun_s
random.seed(3)
signal.signal(signal.SIGALRM, signal.default_int_handler)
caught = 0
for _ in range(60):
    signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-3, duration_s))
    try:
        reconstruct()
        time.sleep(duration_s)
    except KeyboardInterrupt:
        caught += 1
print(caught)
"""


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_interrupt_at_any_moment_is_an_exception(jobs):
    print("seed 3")
    done = subprocess.run([sys.executable, "-c", SCRIPT, str(jobs)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 50
