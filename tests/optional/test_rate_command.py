"""The command from its arguments to its output, and rates as values."""

import re

import gymnasium
import pytest

import pytest_pafot as pafot
from pytest_pafot.__main__ import main
from pytest_pafot.commands import rate_command
from pytest_pafot.commands.rate_command import Rate, compare_rates
from pytest_pafot.model.trace import AdsError
from pytest_pafot.world.engines.episode import Episode
from tests.helpers.sessions import command_in_a_copy

SHORT = [
    "--world", "highway-fast-v0", "--config", '{"vehicles_count": 8, "duration": 12}', "--workers", "1",
]  # fmt: skip


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch):
    """Let lines be long, so that tests can compare them."""
    monkeypatch.setenv("COLUMNS", "999")


def rate(*arguments):
    return main(["rate", *SHORT, *arguments])


def episode(seed, outcome="safe"):
    error = (
        AdsError(kind="KeyError", message="'gap'", traceback="", tick=0)
        if outcome == "ads_error"
        else None
    )
    return Episode(seed, outcome == "collision", error)


def rated(name, **outcomes):
    """Return a rate of ten episodes, with the outcomes of some seeds, `s0="collision"`."""
    return Rate(name, tuple(episode(seed, outcomes.get(f"s{seed}", "safe")) for seed in range(10)))


@pytest.fixture
def crashing(monkeypatch):
    """Return a function that replaces episodes by ones that crash up to a seed, by the name of the policy."""

    def replace(crashes, first="safe"):
        def driven(world, factory, seed, *, is_planner):
            name = next(name for name, made in known.items() if made is factory)
            return episode(
                seed, "collision" if seed < crashes.get(name, 0) else first if seed == 0 else "safe"
            )

        known = {}
        monkeypatch.setattr(
            rate_command, "ads_factory", lambda name: known.setdefault(name, lambda: name)
        )
        monkeypatch.setattr(rate_command, "drive_episode", driven)

    return replace


def test_rate_prints_share_interval_crashes_and_seeds(capsys):
    assert (
        rate("--ads", "constant_speed@planner", "--against", "idm_mobil", "--episodes", "10") == 0
    )
    out, told = capsys.readouterr()
    first, second = map(int, re.findall(r"-v0: (\d+) of 10 ", out))
    assert (first > 1, second) == (True, 0)
    assert "20 of 20" in told


class Trained:
    """A factory that doubts how its policy was loaded, as those of ``pafot.policies`` do."""

    loading_hint = "mind the statistics"

    def __call__(self):
        return lambda observation: 1


trained = Trained()


def test_what_a_loader_doubts_stands_beside_the_rate(capsys):
    assert rate("--ads", f"{__name__}:trained", "--episodes", "1") == 0
    assert "\n  mind the statistics\n" in capsys.readouterr().out


def test_failing_policy_is_counted_and_named(capsys):
    assert rate("--ads", "constant_speed", "--episodes", "2") == 1
    assert "Seeds: 0, 1. First reason: BadAction" in capsys.readouterr().out
    assert rate("--ads", "idm_mobil", "--episodes", "2", "--config", '{"duration": 0}') == 1
    assert "HighwayEnvFast._is_truncated" in capsys.readouterr().err


def fails():
    def decide(observation):
        raise RuntimeError("no weights")

    return decide


def test_policy_that_raises_in_the_first_five_episodes_ends_the_command(capsys):
    assert rate("--ads", f"{__name__}:fails", "--episodes", "200") == 2
    told = capsys.readouterr().err
    assert "RuntimeError: no weights\n  File " in told
    assert (__file__ in told, " of 200 episodes\n" in told) == (True, False)


class Told(gymnasium.Wrapper):
    def reset(self, **options):
        assert options["seed"] != 3, "no reset with the seed 3"
        return super().reset(**options)


def wrapped(duration):
    print("a factory that prints")
    return pafot.World("highway-fast-v0", config={"duration": int(duration)}, wrappers=[Told])


def planned():
    return pafot.World("highway-fast-v0", config={"duration": 4}, planner_hz=5)


def rated_in(world, *arguments):
    few = ["--workers", "1", "--episodes", "2"]
    return main(["rate", "--ads", "idm_mobil", *few, "--world", world, *arguments])


def test_rate_drives_in_an_environment_that_a_factory_makes(capsys):
    assert rated_in(f"{__name__}:wrapped:3") == 0
    assert f"idm_mobil in {__name__}:wrapped:3: 0 of 2 " in capsys.readouterr().out
    assert rated_in(f"{__name__}:planned", "--against", "constant_speed") == 0
    assert f"constant_speed in {__name__}:planned: " in capsys.readouterr().out


NO_ENVIRONMENTS = [
    ["pytest_pafot:Highway"],
    [f"{__name__}:fails"],
    [f"{__name__}:wrapped"],
    [f"{__name__}:wraped"],
    [f"{__name__}:planned", "--config", "{}"],
    [f"{__name__}:wrapped:3", "--seed", "3"],
    ["no_module_of_mine:mine-v0"],
]


@pytest.mark.parametrize("arguments", NO_ENVIRONMENTS)
def test_what_is_no_environment_is_refused(arguments):
    assert rated_in(*arguments) == 2


def test_several_policies_are_compared_with_the_first(capsys, monkeypatch, crashing):
    crashing({"constant_speed": 9, "constant_speed@planner": 2})
    others = ("--against", "constant_speed@planner", "--against", "constant_speed")
    names = ("--ads", "idm_mobil", *others)
    assert rate(*names, "--episodes", "10") == 0
    lines = capsys.readouterr().out.splitlines()
    # McNemar's exact p is 2 / 2^2 of two seeds, and 2 / 2^9 of nine; Holm doubles the smaller one.
    assert re.findall(r"p = ([\d.]+) \(McNemar", "\n".join(lines)) == ["0.5", "0.0078"]
    monkeypatch.setenv("COLUMNS", "60")
    assert rate(*names, "--episodes", "10") == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 60
    assert rate(*names, "--against", "constant_speed") == 2


@pytest.mark.parametrize("at", [3, 7, 12])
def test_ctrl_c_reports_the_completed_episodes(capsys, monkeypatch, at):
    def driven(world, factory, seed, *, is_planner):
        started.append(seed)
        if len(started) == at:
            raise KeyboardInterrupt
        return episode(seed, "collision" if seed == 1 else "safe")

    started = []
    monkeypatch.setattr(rate_command, "drive_episode", driven)
    assert rate("--ads", "idm_mobil", "--against", "constant_speed", "--episodes", "10") == 130
    out, told = capsys.readouterr()
    assert told.endswith("rate: interrupted\n")
    # The two policies take turns, with five episodes each.
    assert ("idm_mobil in highway-fast-v0: 1 of 5 " in out, " 1 with both and 4 " in out) == (
        at > 5,
        at > 10,
    )
    assert ("constant_speed in highway-fast-v0: none of 0 " in out) == (at == 7)


@pytest.mark.parametrize(
    ("crashes", "limit", "code"),
    [(3, "6.6%", 1), (3, "0.066", 1), (3, "6.7 %", 0), (1, "0%", 1), (0, "0", 0)],
)
def test_fail_above_compares_the_lower_end_of_the_interval(capsys, crashing, crashes, limit, code):
    # 3 of 10: the interval of Clopper and Pearson begins at 6.674 %
    crashing({"idm_mobil": crashes})
    assert rate("--ads", "idm_mobil", "--episodes", "10", "--fail-above", limit) == code
    assert ("--fail-above: " in capsys.readouterr().err) == bool(code)


def test_fail_above_refuses_a_policy_that_failed_in_an_episode(capsys, crashing):
    crashing({}, first="ads_error")
    assert rate("--ads", "idm_mobil", "--episodes", "10") == 0
    assert rate("--ads", "idm_mobil", "--episodes", "10", "--fail-above", "2%") == 1


FEW = ("--ads", "constant_speed@planner", "--fail-above", "50%", "--seed", "2", "--episodes")


def test_too_few_episodes_for_a_limit_are_refused():
    assert rate(*FEW, "5") == 2
    assert rate(*FEW, "6") in (0, 1)


WRONG = [
    *(("--fail-above", text) for text in ("2", "100%", "nan", "inf", "-0.1", "2%%", "%", "two")),
    ("--world", "highway-fast-v1"),
    ("--episodes", "0"),
    ("--against", "idm_mobil"),
    ("--ads", "idm_mobile"),
    ("--config", "{count: 3}"),
    ("--config", '{"vehicle_count": 3}'),
    ("--config", "[3]"),
    ("--workers", "0"),
    ("--seed", "-1"),
]


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_wrong_argument_is_refused(arguments):
    assert rate("--ads", "idm_mobil", "--episodes", "2", *arguments) == 2


def test_rate_counts_driven_episodes():
    rate = rated("a", s1="collision", s4="collision", s5="ads_error")
    assert (rate.driven, rate.crashed) == (9, [1, 4])


def test_comparison_uses_seeds_that_crash_only_one_policy():
    first = rated("a", s0="collision", s1="collision", s2="collision", s9="ads_error")
    (told,) = compare_rates(first, [rated("b", s2="collision", s9="collision")])
    assert re.findall(r"\d+", told.partition(": p = ")[0])[-4:] == ["2", "0", "1", "6"]
    assert "p = 0.5 " in told


ENDS = """\
import os


def ends():
    return lambda seen: os._exit(0)
"""


@pytest.mark.processes
def test_workers_give_the_same_rate_as_one_process(tmp_path, capsys):
    given = ["rate", *SHORT[:-2], "--ads", "constant_speed@planner", "--episodes", "30"]
    assert [main([*given, "--workers", number]) for number in ("1", "2")] == [0, 0]
    lines = capsys.readouterr().out.splitlines()
    assert lines[: len(lines) // 2] == lines[len(lines) // 2 :] != []


@pytest.mark.processes
def test_policy_that_ends_its_process_fails_a_gate(tmp_path, monkeypatch):
    (tmp_path / "policies.py").write_text(ENDS)
    monkeypatch.chdir(tmp_path)
    given = ["rate", "--world", "highway-fast-v0", "--episodes", "2"]
    told = command_in_a_copy("pytest_pafot", *given, "--ads", "policies:ends", "--fail-above", "2%")
    assert told.code == 2, told
