"""The shared threads: everything gets done, errors come out, and nobody waits for a busy thread."""

import threading
import time

import pytest

from deepshade import threads


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_every_item_is_done_once(count):
    done = []
    threads.run_all(done.append, range(count), 4)
    assert sorted(done) == list(range(count))


def test_the_first_error_comes_out_and_the_rest_is_left():
    done = []

    def work(item):
        if item == 3:
            raise KeyError(item)
        time.sleep(0.001)
        done.append(item)

    with pytest.raises(KeyError):
        threads.run_all(work, range(1000), 2)
    assert len(done) < 900


def test_an_error_in_another_thread_comes_out():
    caller = threading.get_ident()

    def work(item):
        if threading.get_ident() != caller:
            raise KeyError(item)
        time.sleep(0.01)

    with pytest.raises(KeyError):
        threads.run_all(work, range(100), 2)


def test_a_call_gets_on_while_all_threads_are_busy():
    release = threading.Event()
    many = 32  # more than there are threads
    blocked = threading.Thread(
        target=threads.run_all, args=(lambda _: release.wait(10), range(many), many)
    )
    blocked.start()
    try:
        done = []
        threads.run_all(done.append, range(10), 4)
        assert sorted(done) == list(range(10))
        assert not release.is_set()
    finally:
        release.set()
        blocked.join()
