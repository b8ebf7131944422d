"""Long work: it leaves Python's lock to others, and stops at signals."""

import multiprocessing
import os
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from conftest import torus

import b2p

# A background process may have inherited that Ctrl-C is ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module")
def large():
    """A cloud that takes seconds to encode with optimised quantisation."""
    return torus(900, 600)


def interrupted_after(seconds, call):
    """Presses Ctrl-C while `call` runs, which must not return."""
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            call()
    finally:
        timer.cancel()


def again_and_again(call):
    """Calls for a minute, so that a lost interruption fails a test and does not hang it."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        call()


def test_ctrl_c_stops_encoding_between_its_steps(large):
    steps = []
    interrupted_after(0.3, lambda: b2p.encode(*large, bits=9, bits_per_point=3, progress=steps.append))
    assert steps


def test_ctrl_c_stops_decoding(scene):
    interrupted_after(0.5, lambda: again_and_again(lambda: b2p.decode(scene)))


def test_ctrl_c_stops_drawing(scene_gaussians):
    def draw():
        b2p.render(scene_gaussians, None, 2048, 2048, effects={"supersample": True})

    interrupted_after(0.3, lambda: again_and_again(draw))


def test_other_streams_can_be_decoded_after_an_interruption(scene):
    interrupted_after(0.3, lambda: again_and_again(lambda: list(b2p.open(scene))))
    assert len(list(b2p.open(scene))) == 3


def test_other_threads_run_python_meanwhile(large):
    counted = [0]
    done = threading.Event()

    def count():
        while not done.is_set():
            counted[0] += 1
            time.sleep(0.001)

    other = threading.Thread(target=count)
    other.start()
    try:
        before = counted[0]
        b2p.encode(*large, bits=8)
        assert counted[0] - before > 20
    finally:
        done.set()
        other.join()


def test_calls_from_many_threads_at_once_give_what_one_gives(scene, cloud):
    camera = b2p.Camera.orbit(20, 20)
    wanted = b2p.decode(scene, level=7).positions, b2p.encode(*cloud, bits=6), b2p.render(scene, camera, 64, 64)

    def work(i):
        threads = None if i % 2 else 1 + i % 3
        if i % 3 == 0:
            return np.array_equal(b2p.decode(scene, level=7, threads=threads).positions, wanted[0])
        if i % 3 == 1:
            return b2p.encode(*cloud, bits=6, threads=threads) == wanted[1]
        return np.array_equal(b2p.render(scene, camera, 64, 64, threads=threads), wanted[2])

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(work, range(24)))


def test_a_stream_that_is_in_use_is_refused_and_not_waited_for(scene):
    stream = b2p.Stream()
    stream.push(scene)
    outcomes = []

    def advance():
        try:
            outcomes.append(stream.advance())
        except b2p.UsageError as error:
            outcomes.append(str(error))

    threads = [threading.Thread(target=advance) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    numbers = [outcome for outcome in outcomes if isinstance(outcome, int)]
    assert len(outcomes) == 8 and numbers and len(set(numbers)) == len(numbers)
    assert all(isinstance(o, int) or o is None or "in use" in o for o in outcomes)


def test_the_number_of_threads_does_not_change_results(scene):
    wanted = b2p.decode(scene, level=7).colours
    for threads in [1, 2, 7]:
        assert np.array_equal(b2p.decode(scene, level=7, threads=threads).colours, wanted)
    try:
        b2p.set_threads(1)
        assert np.array_equal(b2p.decode(scene, level=7).colours, wanted)
        b2p.set_threads(3)
        assert np.array_equal(b2p.decode(scene, level=7).colours, wanted)
    finally:
        b2p.set_threads()


def test_progress_hears_of_every_step_and_its_exceptions_come_back(scene):
    steps = []
    b2p.decode(scene, progress=steps.append)
    assert len(steps) > 3 and all(isinstance(step, str) for step in steps)

    def refuse(step):
        raise LookupError(step)

    with pytest.raises(LookupError, match=steps[0]):
        b2p.decode(scene, progress=refuse)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own(scene):
    wanted = b2p.decode(scene, level=7).positions
    context = multiprocessing.get_context("fork")
    with context.Pool(2) as pool:
        found = pool.starmap_async(b2p.decode, [(scene, 7)] * 4).get(60)
    assert all(np.array_equal(gaussians.positions, wanted) for gaussians in found)


def test_memory_is_given_back(scene):
    resource = pytest.importorskip("resource")
    for _ in range(3):
        gaussians = b2p.decode(scene, level=7, heads="surfels")
    one = sum(getattr(gaussians, name).nbytes for name in ("positions", "scales", "rotations", "opacities", "colours"))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(25):
        b2p.decode(scene, level=7, heads="surfels").positions.sum()
    unit = 1 if sys.platform == "darwin" else 1024
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * unit < 10 * one
