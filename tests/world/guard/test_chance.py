"""Global random generators are seeded for each run, and given back."""

import os
import random
import sys
import threading
import traceback
from types import SimpleNamespace

import numpy as np
import pytest

from pytest_pafot import Highway, PositionInstruction, Scenario
from pytest_pafot.world.guard.chance import GENERATORS, _seed_torch

WORLD = Highway(duration=2.0)


def with_seed(seed):
    return Scenario(npcs=((PositionInstruction(8, 22.0),),), gene_seconds=2.0, seed=seed)


def drive(ads, seed=1):
    return GENERATORS.run(WORLD.rollout, with_seed(seed), ads)


def of_python():
    return lambda seen: (random.gauss(0.0, 1.0), 0.0)


def of_numpy():
    return lambda seen: (np.random.normal(), 0.0)


def quiet():
    return lambda seen: (0.0, 0.0)


class Rare:
    """A policy that draws only in scenarios with an odd seed, which the number of its runs does not tell."""

    made = 0

    def __init__(self):
        Rare.made += 1

    def __call__(self, seen):
        return (random.random(), 0.0) if seen.time > 1.0 and Rare.draws else (0.0, 0.0)

    draws = False


@pytest.mark.parametrize("ads", [of_python, of_numpy])
def test_a_scenario_gives_the_same_draws_each_time_and_another_seed_others(ads):
    first, again, other = drive(ads), drive(ads), drive(ads, seed=2)
    assert first.actions == again.actions != other.actions
    assert first.drew
    assert not drive(quiet).drew


def test_numbers_that_only_the_factory_draws_are_seeded_too():
    def ads():
        push = random.random()
        return lambda seen: (push, 0.0)

    assert drive(ads).actions == drive(ads).actions


def test_the_order_of_runs_does_not_matter():
    alone = [drive(of_numpy, seed).actions for seed in range(3)]
    with GENERATORS.held():
        drive(quiet)
        assert [drive(of_numpy, seed).actions for seed in (2, 1, 0)] == alone[::-1]


def test_a_run_that_draws_after_runs_that_did_not_is_made_again_with_its_seed():
    Rare.draws = True
    alone = drive(Rare)
    with GENERATORS.held():
        Rare.draws = False
        assert not drive(Rare).drew
        assert not drive(Rare).drew
        Rare.draws, Rare.made = True, 0
        assert drive(Rare).actions == alone.actions
        assert Rare.made == 2
        assert drive(Rare).actions == alone.actions
        assert Rare.made == 3


def test_the_users_generators_are_given_back_also_after_an_exception_of_the_factory():
    def failing():
        random.random()
        raise RuntimeError("no weights")

    def seed():
        random.seed(5)
        np.random.seed(5)

    seed()
    expected = [random.gauss(0, 1), np.random.normal()]
    seed()
    drive(of_python)
    with GENERATORS.held():
        drive(quiet)
        drive(of_numpy)
    with pytest.raises(RuntimeError):
        drive(failing)
    assert [random.gauss(0, 1), np.random.normal()] == expected


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked on Unix alone")
def test_a_forked_process_makes_no_run_twice():
    Rare.draws = False
    with GENERATORS.held():
        drive(Rare)
        drive(Rare)
        Rare.made = 0
        child = os.fork()
        if not child:
            drive(Rare)
            os._exit(Rare.made)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1


def test_the_generator_of_torch_is_seeded_if_torch_is_imported():
    torch = pytest.importorskip("torch")
    before = torch.get_rng_state()

    def ads():
        return lambda seen: (float(torch.rand(())), 0.0)

    assert drive(ads).actions == drive(ads).actions != drive(ads, seed=2).actions
    assert drive(ads).drew
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("limit", [None, 5, -1])
def test_torch_is_seeded_without_the_text_of_the_stack(monkeypatch, limit):
    """Until its devices are initialised, torch stores that text with each seed; a stand-in does the same."""
    stored = []
    seed = lambda number: stored.append((number, traceback.format_stack()))  # noqa: E731
    monkeypatch.delattr(sys, "tracebacklimit", raising=False)
    if limit is not None:
        monkeypatch.setattr(sys, "tracebacklimit", limit, raising=False)
    _seed_torch(SimpleNamespace(manual_seed=seed), 7)
    assert stored == [(7, [])]
    assert getattr(sys, "tracebacklimit", None) == limit


def test_limit_of_tracebacks_comes_back_if_two_threads_seed_torch_or_it_fails(monkeypatch):
    monkeypatch.delattr(sys, "tracebacklimit", raising=False)
    inner = SimpleNamespace(manual_seed=lambda seed: None)

    def seeds_meanwhile(seed):
        thread = threading.Thread(target=_seed_torch, args=(inner, seed))
        thread.start()
        thread.join()
        raise KeyError(seed)

    with pytest.raises(KeyError):
        _seed_torch(SimpleNamespace(manual_seed=seeds_meanwhile), 7)
    assert not hasattr(sys, "tracebacklimit")


def test_torch_seeds_a_gpu_that_is_initialised_later(monkeypatch):
    torch = pytest.importorskip("torch")
    if torch.cuda.is_initialized():
        pytest.skip("the GPU is initialised already")
    _seed_torch(torch, 7)
    initialise, stack = torch.cuda._lazy_seed_tracker.manual_seed_all_cb
    gpu, expected = torch.Generator(), torch.Generator().manual_seed(7)
    monkeypatch.setattr(torch.cuda, "default_generators", (gpu,))
    monkeypatch.setattr(torch.cuda.random, "device_count", lambda: 1)
    initialise()
    assert stack == []
    assert torch.equal(torch.rand(4, generator=gpu), torch.rand(4, generator=expected))
    expected.manual_seed(7)
    assert torch.equal(torch.rand(4), torch.rand(4, generator=expected))
