"""Calls that do not end: Ctrl-C in one is an exception; a second thread is refused meanwhile."""

import subprocess
import sys
import threading

import numpy as np
import pytest
from line_events import encoded, line_events
from reconstructing import CALIBRATION, KNOWN

from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.core.reconstruction import Reconstructor

INTERRUPTS = """
import random, signal, time

call()
begun_s = time.perf_counter()
call()
duration_s = time.perf_counter() - begun_s
random.seed(3)
signal.signal(signal.SIGALRM, signal.default_int_handler)
caught = 0
for _ in range(60):
    try:
        signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-4, duration_s))
        call()
        time.sleep(duration_s)
    except KeyboardInterrupt:
        caught += 1
print(caught)
"""
RECONSTRUCT = """
import sys

import numpy as np

import eschorty_ros as es
from eschorty_ros.core.evt3 import Encoder

t_us, column, event = np.meshgrid(
    np.arange(20) * 1000 + 100, np.arange(400), np.arange(12), indexing="ij"
)
row, polarity = 350 + event % 3, np.ones(t_us.size, int)
data = Encoder().encode(t_us.ravel(), column.ravel(), row.ravel(), polarity)
calibration, modulation = es.load_calibration("config_3"), es.Modulation(1000.0, on_edge_us=0)


def call():
    reconstructor = es.Reconstructor(calibration, modulation, jobs=int(sys.argv[1]))
    for begin in range(0, len(data), 20_000):
        reconstructor.push(data[begin : begin + 20_000])
    reconstructor.flush()
"""


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_interrupt_at_any_moment_is_an_exception(jobs):
    print("seed 3")
    done = subprocess.run(
        [sys.executable, "-c", RECONSTRUCT + INTERRUPTS, str(jobs)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 45


BOX = """
import numpy as np

from eschorty_ros.core.base.boxed import Boxed

content = tuple(np.zeros(3) for _ in range(100))


def call():
    for _ in range(25):
        Boxed(content)
"""


def test_an_interrupt_while_arrays_are_boxed_is_an_exception():
    print("seed 3")
    done = subprocess.run([sys.executable, "-c", BOX + INTERRUPTS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 45


@pytest.fixture(scope="module")
def data():
    def flat(k, c):
        return np.full(c.shape, 350.0)

    return encoded(line_events(np.random.default_rng(3), flat, periods=12))


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_reconstructor_takes_no_bytes_after_an_interrupted_call(data, jobs):
    reconstructor = Reconstructor(CALIBRATION, KNOWN, jobs=jobs)

    def interrupt(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstructor.push_to(interrupt, data)
    for call in (lambda: reconstructor.push(data), reconstructor.flush):
        with pytest.raises(EschortyError, match="interrupted; make another"):
            call()


def test_a_second_thread_is_refused_while_one_pushes(data):
    reconstructor, refused = Reconstructor(CALIBRATION, KNOWN), []

    def push():
        with pytest.raises(EschortyError, match="another thread"):
            reconstructor.push(data)
        refused.append(True)

    def meanwhile(_):
        thread = threading.Thread(target=push)
        thread.start()
        thread.join()

    reconstructor.push_to(meanwhile, data)
    assert refused
    assert len(reconstructor.flush())


def test_bytes_that_are_refused_leave_a_reconstructor_as_it_is(data):
    reconstructor, other = (Reconstructor(CALIBRATION, KNOWN) for _ in range(2))
    with pytest.raises(EschortyError, match="data"):
        reconstructor.push("events")
    assert len(reconstructor.push(data)) == len(other.push(data)) > 0
