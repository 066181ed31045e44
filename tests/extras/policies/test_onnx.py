"""Networks in ONNX files that tests write by hand, against the same networks in numpy."""

import sys

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.searching import SearchSpace, sample

pytest.importorskip("onnx", reason='needs pip install "pytest-pafot[test]"')
pytest.importorskip("onnxruntime", reason='needs pip install "pytest-pafot[onnx]"')

from tests.helpers.onnx_files import computed, saved_network

WORLD = pafot.World("highway-fast-v0", duration=5.0)
CUT_IN = pafot.Scenario(npcs=[[pafot.PositionInstruction(2, 10.0)]])


def scenarios(count):
    rng = np.random.default_rng(2)
    space = SearchSpace(npcs=3, genes=1, gene_seconds=5.0, speed_limit=26.0)
    return [sample(space, rng) for _ in range(count)]


@pytest.mark.parametrize("shape", [["runs", 5, 5], ["runs", 25], [1, 25]])
def test_onnx_file_drives_by_weights_in_lock_step(shape, tmp_path):
    policy = pafot.policies.onnx(saved_network(tmp_path / "policy.onnx", 25, 5, shape))
    together = WORLD.rollout_batch(scenarios(4), policy)
    for trace in together:
        by_hand = WORLD.rollout(trace.scenario, lambda: lambda seen: int(np.argmax(computed(seen, 5))))
        alone = WORLD.rollout(trace.scenario, policy)
        assert alone.actions == trace.actions == by_hand.actions
        assert alone.states.tobytes() == trace.states.tobytes()
    assert len({action for trace in together for action in trace.actions}) > 1


def test_real_outputs_become_actions_without_batches(tmp_path):
    file = saved_network(tmp_path / "policy.onnx", 14, 2, ["runs", 2, 7])
    policy = pafot.policies.onnx(file, to_action=lambda values: (float(values[0]), 0.001 * float(values[1])))
    assert not hasattr(policy(), "batch")
    trace = pafot.Highway(duration=2.0).rollout(CUT_IN, policy)
    assert trace.error is None
    wanted = []

    def by_hand():
        return lambda seen: wanted.append(computed(seen.array.astype(np.float32), 2)) or trace.actions[len(wanted) - 1]

    pafot.Highway(duration=2.0).rollout(CUT_IN, by_hand)
    assert np.allclose([acceleration for acceleration, _ in trace.actions], [each[0] for each in wanted], rtol=1e-4)


def test_unfitting_network_shape_is_named_with_its_file(tmp_path):
    wide = pafot.policies.onnx(saved_network(tmp_path / "wide.onnx", 35, 5, ["runs", 7, 5]))
    with pytest.raises(
        TypeError, match=r"(?s)wide.onnx with inputs of shape \['runs', 7, 5\], received highway-fast.*5, 5"
    ):
        WORLD.rollout(CUT_IN, wide)
    many = pafot.policies.onnx(saved_network(tmp_path / "many.onnx", 25, 9, ["runs", 25]), to_action=lambda values: 8)
    with pytest.raises(
        TypeError, match=r"expected actions in Discrete\(5\), received .* from 0 to 4, received 8 by .*many"
    ):
        WORLD.rollout_batch([CUT_IN], many)


@pytest.mark.parametrize(("content", "message"), [(b"", "onnxruntime can run"), (None, "a file that can be read")])
def test_invalid_network_file_is_named_in_the_error(content, message, tmp_path):
    if content is not None:
        (tmp_path / "policy.onnx").write_bytes(content)
    with pytest.raises(TypeError, match=rf"{message}, received .*policy.onnx"):
        WORLD.rollout(CUT_IN, pafot.policies.onnx(tmp_path / "policy.onnx"))


def test_missing_onnx_library_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    policy = pafot.policies.onnx(saved_network(tmp_path / "other.onnx", 25, 5, ["runs", 25]))
    with pytest.raises(TypeError, match=r"expected onnxruntime .*pip install 'pytest-pafot\[onnx\]'"):
        WORLD.rollout(CUT_IN, policy)


@pytest.mark.processes
def test_onnx_policy_searches_the_same_when_isolated(tmp_path):
    policy = pafot.policies.onnx(saved_network(tmp_path / "policy.onnx", 25, 5, ["runs", 25]))

    def holds(run):
        assert run.min_distance > 10

    given = {"holds": holds, "world": WORLD, "runs": 3, "seed": 3, "shrink_rollouts": 0, "population": 3}
    here, apart = pafot.explore(policy, **given), pafot.explore(policy, isolate=True, **given)
    assert [each.id for each in here.findings] == [each.id for each in apart.findings] != []
    assert {each.found.weights for each in here.findings} == {policy.weights_digest}
