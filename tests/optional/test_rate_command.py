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
    "--world",
    "highway-fast-v0",
    "--config",
    '{"vehicles_count": 8, "duration": 12}',
    "--workers",
    "1",
]


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
    found = re.search(
        r"^constant_speed@planner in highway-fast-v0: (\d) of 10 episodes crashed, [\d.]+ % \(95 %",
        out,
    )
    assert int(found[1]) > 1
    assert (
        "idm_mobil in highway-fast-v0: 0 of 10 episodes crashed, 0 % (95 %: at most 31 %)\n" in out
    )
    assert "0 only with idm_mobil, 0 with both" in out
    assert "rate: 20 of 20 episodes\n" in told


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
    out, told = capsys.readouterr()
    assert "to complete most of 2 episodes, but it completed 0. Reason in 2 episodes: BadA" in told
    assert "none of 2 episodes was completed" in out
    assert (
        "not counted: 2 episodes that did not start or ended with an error. Seeds: 0, 1. First reason: BadAct"
        in out
    )
    assert "write @planner after the name" in out.replace("\n ", "")
    assert rate("--ads", "idm_mobil", "--episodes", "2", "--config", '{"duration": 0}') == 1
    assert (
        "Reason in 2 episodes: HighwayEnvFast._is_truncated ended it in step 1. Correct"
        in capsys.readouterr().err
    )


def fails():
    def decide(observation):
        raise RuntimeError("no weights")

    return decide


def test_policy_that_raises_in_the_first_five_episodes_ends_the_command(capsys):
    assert rate("--ads", f"{__name__}:fails", "--episodes", "200") == 2
    told = capsys.readouterr().err
    assert (
        "in each of the first 5 episodes, starting with seed 0: RuntimeError: no weights\n  File "
        in told
    )
    assert ("test_rate_command.py" in told, " of 200 episodes\n" in told) == (True, False)


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
    return main(
        [
            "rate",
            "--ads",
            "idm_mobil",
            "--workers",
            "1",
            "--episodes",
            "2",
            "--world",
            world,
            *arguments,
        ]
    )


def test_rate_drives_in_an_environment_that_a_factory_makes(capsys):
    assert rated_in(f"{__name__}:wrapped:3") == 0
    assert (
        "idm_mobil in tests.optional.test_rate_command:wrapped:3: 0 of 2 episodes"
        in capsys.readouterr().out
    )
    assert rated_in(f"{__name__}:planned", "--against", "constant_speed") == 0
    assert "constant_speed in test" in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "text"), [
    (["pytest_pafot:Highway"], "--world: expected an environment with ordinary traffic, "),
    ([f"{__name__}:fails"], "fails' to return pafot.Highway(...), pafot.World(...) or "),
    ([f"{__name__}:wrapped"], "wrapped', which raises TypeError: wrapped() missing 1 required"),
    ([f"{__name__}:wraped"], ". Did you mean 'tests.optional.test_rate_command:wrapped'?"),
    ([f"{__name__}:planned", "--config", "{}"], "--world: expected the id of an environment for --config, rec"),
    ([f"{__name__}:wrapped:3", "--seed", "3"], "to reset with the seed 3, received AssertionError: no reset"),
    (["no_module_of_mine:mine-v0"], "(ModuleNotFoundError: No module named 'no_module_of_mine'). Change to the"),
])  # fmt: skip
def test_what_is_no_environment_is_refused_by_its_name(arguments, text, capsys):
    assert rated_in(*arguments) == 2
    assert text in capsys.readouterr().err


def test_several_policies_are_compared_with_the_first(capsys, monkeypatch, crashing):
    crashing({"constant_speed": 9, "constant_speed@planner": 2})
    names = (
        "--ads",
        "idm_mobil",
        "--against",
        "constant_speed@planner",
        "--against",
        "constant_speed",
    )
    assert rate(*names, "--episodes", "10") == 0
    lines = capsys.readouterr().out.splitlines()
    told = [line for line in lines if line.startswith("on the same")]
    # McNemar's exact p is 2 / 2^2 of two seeds, and 2 / 2^9 of nine; Holm doubles the smaller one.
    assert told[0].endswith("p = 0.5 (McNemar, exact, two-sided, Holm for 2)")
    assert told[1].endswith("p = 0.0078 (McNemar, exact, two-sided, Holm for 2)")
    monkeypatch.setenv("COLUMNS", "60")
    assert rate(*names, "--episodes", "10") == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 60
    assert rate(*names, "--against", "constant_speed") == 2
    assert (
        "expected each policy only once, received 'constant_speed' again" in capsys.readouterr().err
    )


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
    first, both = (
        "idm_mobil in highway-fast-v0: 1 of 5 episodes crashed",
        "0 only with constant_speed, 1 with both",
    )
    assert (first in out, f"{both} and 4 with neither" in out) == (at > 5, at > 10)
    assert ("constant_speed in highway-fast-v0: none of 0 episodes" in out) == (at == 7)


@pytest.mark.parametrize(
    ("crashes", "limit", "code"),
    [(3, "6.6%", 1), (3, "0.066", 1), (3, "6.7 %", 0), (1, "0%", 1), (0, "0", 0)],
)
def test_fail_above_compares_the_lower_end_of_the_interval(capsys, crashing, crashes, limit, code):
    # 3 of 10: the interval of Clopper and Pearson begins at 6.674 %
    crashing({"idm_mobil": crashes})
    assert rate("--ads", "idm_mobil", "--episodes", "10", "--fail-above", limit) == code
    assert ("received a confidence interval that starts at" in capsys.readouterr().err) == bool(
        code
    )


def test_fail_above_refuses_a_policy_that_failed_in_an_episode(capsys, crashing):
    crashing({}, first="ads_error")
    assert rate("--ads", "idm_mobil", "--episodes", "10") == 0
    assert rate("--ads", "idm_mobil", "--episodes", "10", "--fail-above", "2%") == 1
    assert (
        "--fail-above: expected episodes without an error, received 1 with an error\n"
        in capsys.readouterr().err
    )


def test_too_few_episodes_for_a_limit_are_refused_with_enough(capsys):
    arguments = ("--ads", "constant_speed@planner", "--fail-above", "50%", "--seed", "2")
    assert rate(*arguments, "--episodes", "5") == 2
    told = "--episodes: expected more episodes, received 5. Even if all of them crash, they cannot show a crash rate"
    assert told in capsys.readouterr().err
    assert rate(*arguments, "--episodes", "6") in (0, 1)


@pytest.mark.parametrize(("arguments", "text"), [
    *((["--fail-above", text], "--fail-above: expected at least 0 and less than 1, such as 2% or 0.02, received")
      for text in ("2", "100%", "nan", "inf", "-0.1", "2%%", "%", "two")),
    (["--world", "highway-fast-v1"], "expected a registered environment, received 'highway-fast-v1'"),
    (["--episodes", "0"], "--episodes: expected a whole number, at least 1, received 0"),
    (["--against", "idm_mobil"], "--against: expected each policy only once"),
    (["--ads", "idm_mobile"], "Did you mean 'idm_mobil'?"),
    (["--config", "{count: 3}"], "--config: expected JSON such as"),
    (["--config", '{"vehicle_count": 3}'], "Did you mean 'vehicles_count'?"),
    (["--config", "[3]"], "--config: expected JSON such as '{\"vehicles_count\": 20}', received [3]"),
    (["--workers", "0"], "--workers: expected a whole number, at least 1, received 0"),
    (["--seed", "-1"], "--seed: expected a whole number, at least 0, received -1"),
])  # fmt: skip
def test_wrong_argument_is_reported_with_the_way_out(arguments, text, capsys):
    assert rate("--ads", "idm_mobil", "--episodes", "2", *arguments) == 2
    assert text in capsys.readouterr().err


def test_rate_counts_driven_episodes():
    rate = rated("a", s1="collision", s4="collision", s5="ads_error")
    assert (rate.driven, rate.crashed) == (9, [1, 4])
    assert rate.lines == [
        "2 of 9 episodes crashed, 22.2 % (95 %: 2.8 to 60.0 %)",
        "  seeds of the crashes: 1, 4",
        "  not counted: 1 episode that did not start or ended with an error. Seeds: 5. First reason: KeyError: 'gap'",
    ]


def test_of_many_seeds_the_first_ten_are_told():
    rate = Rate("a", tuple(episode(seed, "collision") for seed in range(12)))
    assert rate.lines[1] == "  seeds of the crashes: 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 2 more"


def test_comparison_uses_seeds_that_crash_only_one_policy():
    first = rated("a", s0="collision", s1="collision", s2="collision", s9="ads_error")
    (told,) = compare_rates(first, [rated("b", s2="collision", s9="collision")])
    assert (
        "2 episodes crashed only with a, 0 only with b, 1 with both and 6 with neither: p = 0.5 (McN"
        in told
    )


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
    assert (told.code, "expected the process with the policy to finish" in told.err) == (2, True), (
        told
    )
