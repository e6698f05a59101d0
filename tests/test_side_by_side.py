"""Threads that compute alone: what they find is what one thread finds, and nobody else notices them."""

import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from sdfhub.model.activations import Hosc, Siren
from sdfhub.model.decoder import activated
from sdfhub.model.dropout import drawn_from, dropout_factors
from sdfhub.model.fast.computing import Computing, distances
from sdfhub.model.fast.side_by_side import _pool, side_by_side
from sdfhub.model.fast.waves import ALONE
from tests.test_model import small_decoder
from tests.test_training import batches
from tests.tiny import build_autodecoder, composed

FORKED = """
import os, torch
from sdfhub.model.fast.side_by_side import side_by_side
torch.set_num_threads(2)
work = lambda number: number + 1
assert side_by_side(work, range(4)) == [1, 2, 3, 4]
child = os.fork()
if child == 0:
    os._exit(0 if side_by_side(work, range(4)) == [1, 2, 3, 4] else 1)
assert os.waitpid(child, 0)[1] == 0
"""


def alone(call):
    """What a call gives on one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return call()
    finally:
        torch.set_num_threads(before)


def test_results_are_in_order_and_each_is_computed_by_one_of_several_threads(several):
    gate = threading.Barrier(several, timeout=30)  # opens only if all work at once

    def work(number: int) -> tuple[int, int, str]:
        gate.wait()
        return number, torch.get_num_threads(), threading.current_thread().name

    found = side_by_side(work, range(2 * several))
    assert [number for number, *_ in found] == list(range(2 * several))
    assert {threads for _, threads, _ in found} == {1}
    assert threading.current_thread().name not in {name for *_, name in found}


def test_the_callers_number_of_threads_and_that_of_later_threads_stay(several):
    _pool.cache_clear()
    side_by_side(lambda _: None, range(4))
    later = []
    thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert torch.get_num_threads() == several and later == [several]


def test_one_item_or_one_thread_is_a_plain_loop(several):
    def here(_) -> bool:
        return threading.current_thread() is threading.main_thread()

    assert side_by_side(here, range(1)) == [True] and side_by_side(here, []) == []
    assert alone(lambda: side_by_side(here, range(3))) == [True] * 3
    inside = side_by_side(lambda _: side_by_side(lambda _: threading.get_ident(), range(3)), range(4))
    assert all(len(set(threads)) == 1 for threads in inside)


def test_work_is_done_in_the_modes_of_the_caller(several):
    def modes(_=None):
        kind = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else None
        return torch.is_grad_enabled(), torch.is_inference_mode_enabled(), kind

    for mode in (torch.no_grad(), torch.inference_mode(), torch.autocast("cpu", torch.bfloat16)):
        with mode:
            assert side_by_side(modes, range(4)) == [modes()] * 4
    assert side_by_side(modes, range(4)) == [(True, False, None)] * 4


def test_the_first_failure_is_raised_and_work_not_begun_is_left_out(several):
    begun = []

    def work(number: int) -> None:
        begun.append(number)
        if number == 1:
            raise ValueError("one")
        time.sleep(0.05)

    with pytest.raises(ValueError, match="one"):
        side_by_side(work, range(100))
    assert len(begun) < 100
    assert side_by_side(abs, [-1, 2, -3]) == [1, 2, 3]


def test_several_callers_share_the_threads(several):
    with ThreadPoolExecutor(4) as callers:
        found = list(callers.map(lambda first: side_by_side(abs, range(first, 0)), range(-9, -1)))
    assert found == [list(range(-first, 0, -1)) for first in range(-9, -1)]


def test_an_interruption_leaves_no_thread_at_work(several):
    """As Ctrl-C comes: in the calling thread, while it waits."""
    ended = []

    def work(number: int) -> None:
        time.sleep(0.5)
        ended.append(number)

    here = threading.get_ident()
    timer = threading.Timer(0.2, signal.pthread_kill, [here, signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        side_by_side(work, range(100))
    count = len(ended)
    assert 0 < count < 100
    time.sleep(0.7)
    assert len(ended) == count


def test_a_forked_process_has_threads_of_its_own():
    assert subprocess.run([sys.executable, "-c", FORKED], timeout=120).returncode == 0


@pytest.mark.parametrize("activation", [Siren(15.0, 3.0), Hosc(15.0, 3.0, 2.0)], ids=repr)
def test_a_loop_on_several_threads_is_the_loop_on_one(activation, several):
    torch.manual_seed(0)
    product = torch.randn(3, 2 * ALONE // 60, 21, requires_grad=True)
    shift = torch.randn(3, 1, 21, requires_grad=True)
    assert product.numel() > ALONE
    by = torch.randn(product.shape)

    def found():
        value = activated(activation, product, shift)[0]
        return value, *torch.autograd.grad(value, [product, shift], by)

    for have, want in zip(found(), alone(found), strict=True):
        assert torch.equal(have, want)


@pytest.mark.parametrize("experiment", ["deepsdf", "fft_hosc", "hash_siren"])
def test_a_step_on_several_threads_is_the_step_on_one(experiment, several):
    """With DeepSDF's dropout and its longest codes, too."""
    config = composed(f"experiment={experiment}", "decoder.width=300", "computing.points_at_once=70")
    torch.manual_seed(0)
    model, batch = build_autodecoder(config, rows=5), batches(per_step=5)[0]
    codes, learned = 3 * model.codes.table.detach(), list(model.parameters())  # some are too long

    def found():
        torch.manual_seed(1)
        model.codes.table.data.copy_(codes)
        loss, parts = model.objective(batch, progress=0.5)
        return loss, *parts.values(), *torch.autograd.grad(loss, learned)

    have, want, again = found(), alone(found), found()
    for one, other in zip(have, want, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    assert all(torch.equal(one, other) for one, other in zip(have, again, strict=True))


def test_dropout_drawn_from_a_seed_is_a_function_of_it():
    hidden = torch.ones(100)

    def factors(seed):
        with drawn_from(seed):
            return dropout_factors(hidden, 0.5)

    assert torch.equal(factors(3), factors(3)) and not torch.equal(factors(3), factors(4))
    torch.manual_seed(0)
    outside = dropout_factors(hidden, 0.5)
    torch.manual_seed(0)
    assert torch.equal(factors(None), outside)


def test_a_batch_is_shared_by_the_threads_until_shares_are_small(several):
    cpu = torch.device("cpu")
    assert Computing().together(cpu, several * 5000) == 5000
    assert Computing().together(cpu, 2**20) == 2**13
    assert Computing().together(cpu, several * 10) == 2**10
    assert Computing().threads(cpu) == several and Computing(compile=True).threads(cpu) == 1
    assert Computing().threads(torch.device("cuda")) == 1


@pytest.mark.parametrize("shapes", [1, 3])
@pytest.mark.parametrize("count", [5003, 1, 0])
def test_distances_in_parts_are_those_of_the_decoder(shapes, count, several):
    torch.manual_seed(0)
    decoder = small_decoder().eval()
    points, codes = torch.rand(shapes, count, 3) - 0.5, torch.randn(shapes, 4)
    with torch.no_grad():
        torch.testing.assert_close(distances(decoder, points, codes), decoder(points, codes))
