"""Models of Stable-Baselines3; the tests need it installed, with torch, which is large."""

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.searching import sample
from pytest_pafot.searching.space import SearchSpace

stable_baselines3 = pytest.importorskip("stable_baselines3", reason='needs pip install "pytest-pafot[sb3]"')
sb3_contrib = pytest.importorskip("sb3_contrib", reason='needs pip install "pytest-pafot[sb3]"')

from tests.helpers.sb3_models import CONTINUOUS, ENV, InItsWrappers, saved_model  # noqa: E402

WORLD = pafot.World(ENV, duration=10.0)
OF_DISCRETE_ACTIONS = (
    *(getattr(stable_baselines3, name) for name in ("PPO", "A2C", "DQN")),
    *(getattr(sb3_contrib, name) for name in ("QRDQN", "TRPO", "MaskablePPO", "RecurrentPPO", "ARS")),
)
OF_CONTINUOUS_ACTIONS = (
    *(getattr(stable_baselines3, name) for name in ("SAC", "TD3")),
    *(getattr(sb3_contrib, name) for name in ("TQC", "CrossQ")),
)
POLICIES = {"MaskablePPO": "MlpPolicy", "RecurrentPPO": "MlpLstmPolicy"}


def scenarios(count):
    rng = np.random.default_rng(0)
    space = SearchSpace(npcs=3, genes=2, gene_seconds=5.0, speed_limit=26.0)
    return [sample(space, rng) for _ in range(count)]


def same(a, b):
    return a.states.tobytes() == b.states.tobytes() and np.array_equal(a.actions, b.actions)


@pytest.fixture(scope="module")
def framed(tmp_path_factory):
    """Return PPO on three frames of normalised observations."""
    folder = tmp_path_factory.mktemp("framed")
    return saved_model(
        folder, stable_baselines3.PPO, frames=3, is_normalised=True, steps=256, n_steps=64, learning_rate=0.01
    )


@pytest.mark.parametrize(
    ("cls", "config"),
    [*((cls, {}) for cls in OF_DISCRETE_ACTIONS), *((cls, CONTINUOUS) for cls in OF_CONTINUOUS_ACTIONS)],
)
def test_zip_names_algorithm_and_policy_decides_like_predict(cls, config, tmp_path):
    file, _ = saved_model(tmp_path, cls, config=config, policy=POLICIES.get(cls.__name__, "MlpPolicy"))
    policy = pafot.policies.sb3(file)
    world = pafot.World(ENV, config=config or None, duration=10.0)
    model = cls.load(file, device="cpu")
    for drive in (world.rollout, world.rollout_in_gym):
        (scenario,) = scenarios(1)
        assert same(drive(scenario, policy), drive(scenario, lambda: InItsWrappers(model, world)))


def test_policy_with_statistics_and_frames_decides_like_wrappers(framed):
    file, statistics = framed
    policy = pafot.policies.sb3(file, vecnormalize=statistics, frame_stack=3)
    model = stable_baselines3.PPO.load(file, device="cpu")
    traces = [WORLD.rollout(scenario, policy) for scenario in scenarios(10)]
    for trace in traces:
        in_gym = WORLD.rollout_in_gym(trace.scenario, policy)
        assert in_gym.actions == trace.actions
        assert same(
            in_gym, WORLD.rollout_in_gym(trace.scenario, lambda: InItsWrappers(model, WORLD, statistics, frames=3))
        )
    assert len({action for trace in traces for action in trace.actions}) > 1


def test_statistics_of_stacked_observations_are_recognised_by_shape(tmp_path):
    from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

    from tests.helpers.sb3_models import Shown

    shown = Shown(WORLD.observation_space, WORLD.action_space)
    rng = np.random.default_rng(1)
    shown.next = rng.normal(size=(5, 5)).astype(np.float32)
    env = VecNormalize(VecFrameStack(DummyVecEnv([lambda: shown]), 2))
    model = stable_baselines3.PPO("MlpPolicy", env, device="cpu", n_steps=64)
    env.reset()
    for _ in range(8):
        shown.next = rng.normal(size=(5, 5)).astype(np.float32)
        env.step([0])
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))
    env.training = False
    policy = pafot.policies.sb3(tmp_path / "model.zip", vecnormalize=tmp_path / "statistics.pkl", frame_stack=2)
    ads, seen = policy(), env.reset()
    for _ in range(20):
        assert ads(shown.next) == model.predict(seen, deterministic=True)[0][0]
        shown.next = rng.normal(size=(5, 5)).astype(np.float32)
        seen = env.step([0])[0]


def test_spaces_that_differ_are_both_named(framed):
    file, statistics = framed
    policy = pafot.policies.sb3(file, vecnormalize=statistics)
    with pytest.raises(TypeError, match=r"(?s)observations Box\(.*\(5, 15\).*received highway-fast-v0 .*\(5, 5\)"):
        WORLD.rollout(scenarios(1)[0], policy)
    with pytest.raises(TypeError, match="received Highway, whose observations are pafot"):
        pafot.Highway().rollout(scenarios(1)[0], policy)
    continuous = pafot.World(ENV, config=CONTINUOUS)
    framed_policy = pafot.policies.sb3(file, vecnormalize=statistics, frame_stack=3)
    with pytest.raises(TypeError, match=r"Discrete\(5\).*received .*actions Box\(-1.0, 1.0, \(2,\)"):
        continuous.rollout(scenarios(1)[0], framed_policy)
