"""Jobs run in the worker that the caller waits for, or never."""

import threading

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.live.job_queue import JobQueue


def work(jobs: JobQueue) -> None:
    while (job := jobs.next(0.0)) is not None:
        job()


def test_a_job_that_its_caller_gave_up_never_begins():
    jobs, done = JobQueue(1), []
    given_up = jobs.run(lambda: done.append(1), 0.01, lambda: True)
    assert given_up == (False, "the reconstruction did not answer within 0.01 s")
    ended = jobs.run(lambda: done.append(1), 10.0, lambda: False)
    assert ended == (False, "the node was shut down")
    work(jobs)
    assert done == []
    assert jobs.run(lambda: done.append(2), 0.0, lambda: True) == (True, "")
    work(jobs)
    assert done == [2]


def test_a_job_that_has_begun_is_waited_for():
    jobs, begun, go, answers = JobQueue(1), threading.Event(), threading.Event(), []

    def job() -> None:
        begun.set()
        assert go.wait(10.0)
        raise ArgumentError("no such scan")

    caller = threading.Thread(target=lambda: answers.append(jobs.run(job, 0.05, lambda: True)))
    caller.start()
    worker = threading.Thread(target=lambda: jobs.next(10.0)())
    worker.start()
    assert begun.wait(10.0)
    caller.join(0.3)
    assert answers == []
    go.set()
    caller.join(10.0)
    worker.join(10.0)
    assert answers == [(False, "no such scan")]
