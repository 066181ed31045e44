"""Models of Stable-Baselines3; the tests need it installed, with torch, which is large."""

from functools import partial

import gymnasium
import highway_env  # noqa: F401  (registers its environments)
import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.algorithms import sample
from pytest_pafot.algorithms.space import SearchSpace

stable_baselines3 = pytest.importorskip(
    "stable_baselines3", reason='needs pip install "pytest-pafot[sb3]"'
)
sb3_contrib = pytest.importorskip("sb3_contrib", reason='needs pip install "pytest-pafot[sb3]"')

from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize  # noqa: E402

ENV = "highway-fast-v0"
CONTINUOUS = {"action": {"type": "ContinuousAction"}}

WORLD = pafot.World(ENV, duration=10.0)
OF_DISCRETE_ACTIONS = (
    *(getattr(stable_baselines3, name) for name in ("PPO", "A2C", "DQN")),
    *(
        getattr(sb3_contrib, name)
        for name in ("QRDQN", "TRPO", "MaskablePPO", "RecurrentPPO", "ARS")
    ),
)
OF_CONTINUOUS_ACTIONS = (
    *(getattr(stable_baselines3, name) for name in ("SAC", "TD3")),
    *(getattr(sb3_contrib, name) for name in ("TQC", "CrossQ")),
)
POLICIES = {"MaskablePPO": "MlpPolicy", "RecurrentPPO": "MlpLstmPolicy"}


def saved_model(
    folder,
    cls,
    *,
    config=None,
    frames=1,
    is_normalised=False,
    steps=0,
    policy="MlpPolicy",
    **arguments,
):
    """Save a model trained for a number of steps, and its statistics; return their files."""
    env = DummyVecEnv(
        [partial(gymnasium.make, ENV, config={"vehicles_count": 5, **(config or {})})]
    )
    env.seed(1)
    if is_normalised:
        env = VecNormalize(env)
    if frames > 1:
        env = VecFrameStack(env, frames)
    model = cls(
        policy, env, seed=1, device="cpu", policy_kwargs={"net_arch": [32, 32]}, **arguments
    )
    if steps:
        model.learn(steps)
    model.save(folder / "model.zip")
    if is_normalised:
        model.get_vec_normalize_env().save(folder / "statistics.pkl")
    return folder / "model.zip", folder / "statistics.pkl" if is_normalised else None


class Shown(gymnasium.Env):
    """An environment that returns whatever observation it is given."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space
        self.next = None

    def reset(self, *, seed=None, options=None):
        return self.next, {}

    def step(self, action):
        return self.next, 0.0, False, False, {}


class InItsWrappers:
    """An ADS that uses VecNormalize and VecFrameStack themselves, and decides by ``model.predict``."""

    def __init__(self, model, world, statistics=None, frames=1):
        self.model, self.state = model, None
        self.shown = Shown(world.observation_space, world.action_space)
        self.env = DummyVecEnv([lambda: self.shown])
        if statistics is not None:
            self.env = VecNormalize.load(str(statistics), self.env)
            self.env.training = False
        if frames > 1:
            self.env = VecFrameStack(self.env, frames)
        self.action = None

    def __call__(self, observation):
        self.shown.next = observation
        start = np.array([self.action is None])
        seen = self.env.reset() if self.action is None else self.env.step(self.action)[0]
        self.action, self.state = self.model.predict(seen, self.state, start, deterministic=True)
        return self.action[0]


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
        folder,
        stable_baselines3.PPO,
        frames=3,
        is_normalised=True,
        steps=256,
        n_steps=64,
        learning_rate=0.01,
    )


@pytest.mark.parametrize(
    ("cls", "config"),
    [
        *((cls, {}) for cls in OF_DISCRETE_ACTIONS),
        *((cls, CONTINUOUS) for cls in OF_CONTINUOUS_ACTIONS),
    ],
)
def test_zip_names_algorithm_and_policy_decides_like_predict(cls, config, tmp_path):
    file, _ = saved_model(
        tmp_path, cls, config=config, policy=POLICIES.get(cls.__name__, "MlpPolicy")
    )
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
            in_gym,
            WORLD.rollout_in_gym(
                trace.scenario, lambda: InItsWrappers(model, WORLD, statistics, frames=3)
            ),
        )
    assert len({action for trace in traces for action in trace.actions}) > 1


def test_statistics_of_stacked_observations_are_recognised_by_shape(tmp_path):
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
    policy = pafot.policies.sb3(
        tmp_path / "model.zip", vecnormalize=tmp_path / "statistics.pkl", frame_stack=2
    )
    ads, seen = policy(), env.reset()
    for _ in range(20):
        assert ads(shown.next) == model.predict(seen, deterministic=True)[0][0]
        shown.next = rng.normal(size=(5, 5)).astype(np.float32)
        seen = env.step([0])[0]


def test_spaces_that_differ_are_both_named(framed):
    file, statistics = framed
    policy = pafot.policies.sb3(file, vecnormalize=statistics)
    with pytest.raises(
        TypeError, match=r"(?s)observations Box\(.*\(5, 15\).*received highway-fast-v0 .*\(5, 5\)"
    ):
        WORLD.rollout(scenarios(1)[0], policy)
    with pytest.raises(TypeError, match="received Highway, whose observations are pafot"):
        pafot.Highway().rollout(scenarios(1)[0], policy)
    continuous = pafot.World(ENV, config=CONTINUOUS)
    framed_policy = pafot.policies.sb3(file, vecnormalize=statistics, frame_stack=3)
    with pytest.raises(
        TypeError, match=r"Discrete\(5\).*received .*actions Box\(-1.0, 1.0, \(2,\)"
    ):
        continuous.rollout(scenarios(1)[0], framed_policy)
