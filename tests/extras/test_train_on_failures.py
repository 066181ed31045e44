"""The counts of an policy before and after training on its failures; training itself needs stable-baselines3."""

import numpy as np
import pytest

from example_ads import ppo
from tests.benchmarks import train_on_failures
from tests.benchmarks.train_on_failures import TRAINED_ON, faults, measured, row, scenarios

COUNT = 12
"""The number of random scenarios in each count."""
TO_THE_RIGHT = ppo.PpoPolicy(((np.zeros((25, 5), np.float32), np.float32([0, 0, 1, 0, 0])),))
"""A policy that changes to the next lane, and then on to the last one."""


@pytest.fixture(scope="module")
def before():
    return measured("before", ppo.make(), scenarios(4, COUNT), 5)


def test_shipped_policy_fails_often_and_behind_a_leader(before):
    failed = [fault for fault in before.faults if fault is not None]
    assert len(failed) > COUNT / 3
    assert failed.count(TRAINED_ON) > len(failed) / 2


def test_row_has_all_failure_kinds_and_ordinary_traffic(before):
    failed, kind = sum(map(bool, before.faults)), before.faults.count(TRAINED_ON)
    name, random, trained_on, others, ordinary = row(before, before).strip("| ").split(" | ")
    assert name == "before"
    assert random.startswith(f"{100 * failed / COUNT:.1f} % (95 %: ")
    assert (random.endswith(f"of {COUNT}"), ordinary.endswith("of 5")) == (True, True)
    assert trained_on == f"100 % (95 %: {trained_on.split('95 %: ')[1]}"
    assert trained_on.endswith(f"of {kind}")
    assert others.endswith(f"of {failed - kind}")


def test_failures_after_training_count_among_those_before(before):
    after = measured("to the right", TO_THE_RIGHT, scenarios(4, COUNT), 5)
    still = sum(then == TRAINED_ON and now is not None for then, now in zip(before.faults, after.faults, strict=True))
    share = 100 * still / before.faults.count(TRAINED_ON)
    assert 0 < share < 100
    assert row(before, after).split(" | ")[2].startswith(f"{share:.1f} %")


def test_training_begins_with_shipped_policy_and_changes_it(monkeypatch):
    pytest.importorskip("torch", reason='needs pip install "pytest-pafot[train]"')
    pytest.importorskip("stable_baselines3", reason='needs pip install "pytest-pafot[train]"')
    monkeypatch.setattr(train_on_failures, "CRITIC_STEPS", 512)
    given = scenarios(2, 20)
    assert faults(train_on_failures.trained(given, 0.5, 0, 0), given) == faults(ppo.make(), given)
    changed = train_on_failures.trained(given, 0.5, 512, 0)
    seen = np.random.default_rng(1).uniform(-1, 1, size=(5, 5)).astype(np.float32)
    assert not np.array_equal(changed.logits(seen), ppo.make().logits(seen))
