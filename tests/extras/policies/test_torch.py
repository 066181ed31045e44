"""Modules of torch; the tests need it installed, and it is large."""

import pickle

import numpy as np
import pytest

import pytest_pafot as pafot

torch = pytest.importorskip("torch", reason="needs pip install torch")

WORLD = pafot.World("highway-fast-v0", duration=5.0)
CUT_IN = pafot.Scenario(npcs=[[pafot.PositionInstruction(2, 10.0)]])


@pytest.fixture
def module():
    torch.manual_seed(3)
    return torch.nn.Sequential(
        torch.nn.Flatten(), torch.nn.Linear(25, 32), torch.nn.Dropout(), torch.nn.Tanh(), torch.nn.Linear(32, 5)
    )


def given_as(kind, module, folder):
    if kind == "module":
        return module
    if kind == "whole":
        torch.save(module, folder / "module.pt")
    else:
        torch.jit.save(torch.jit.trace(module.eval(), torch.zeros(1, 5, 5)), folder / "module.pt")
    return folder / "module.pt"


@pytest.mark.filterwarnings("ignore:.*torch.jit")
@pytest.mark.parametrize("kind", ["module", "whole", "script"])
def test_module_decides_exactly_as_it_does_alone(kind, module, tmp_path):
    policy = pafot.policies.torch(given_as(kind, module, tmp_path))
    was_training = module.training
    trace = WORLD.rollout(CUT_IN, policy)
    assert module.training is was_training
    evaluated = module.eval()

    def by_hand():
        return lambda seen: int(evaluated(torch.from_numpy(seen)[None])[0].argmax())

    assert trace.error is None
    assert WORLD.rollout(CUT_IN, by_hand).states.tobytes() == trace.states.tobytes()
    assert WORLD.rollout_batch([CUT_IN, CUT_IN], policy)[1].actions == trace.actions
    assert torch.get_num_threads() == 1
    assert policy.weights_digest.startswith("sha256:")


def test_module_hash_depends_on_its_weights(module):
    policy = pafot.policies.torch(module)
    assert pickle.loads(pickle.dumps(policy)).weights_digest == policy.weights_digest
    with torch.no_grad():
        module[1].bias[0] += 1
    assert pafot.policies.torch(module).weights_digest != policy.weights_digest


def test_real_numbers_are_made_to_actions(module):
    world = pafot.World("highway-fast-v0", config={"action": {"type": "ContinuousAction"}}, duration=3.0)
    policy = pafot.policies.torch(module, to_action=lambda values: np.tanh(values[:2]))
    assert world.rollout(CUT_IN, policy).error is None
    assert not hasattr(policy(), "batch")


def test_what_does_not_fit_is_named(module, tmp_path):
    world = pafot.World("highway-fast-v0", config={"observation": {"type": "Kinematics", "vehicles_count": 7}})
    with pytest.raises(
        TypeError, match=r"(?s)the module Sequential, received highway-fast-v0 .*7, 5.*cannot be multiplied"
    ):
        world.rollout(CUT_IN, pafot.policies.torch(module))
    torch.save(module.state_dict(), tmp_path / "weights.pt")
    with pytest.raises(TypeError, match=r"contains an OrderedDict; make the module, load the weights into it"):
        WORLD.rollout(CUT_IN, pafot.policies.torch(tmp_path / "weights.pt"))
