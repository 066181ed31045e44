"""Options: one table, three sources, one precedence."""

import re

import pytest

from pytest_pafot.plugin.session import resolve
from pytest_pafot.searches.options import OPTIONS, is_ci
from pytest_pafot.searches.request import SearchArguments, SpaceArguments
from pytest_pafot.support.errors import RequestError


@pytest.fixture
def project(project, monkeypatch):
    """Return a project without the keys that other projects have."""
    monkeypatch.delenv("PYTEST_ADDOPTS")
    return project


def settings(project, *args, ini="", marker=None):
    """Return the settings of a config that is made from these sources."""
    if ini:
        project.pytester.makeini(f"[pytest]\n{ini}")
    # One config with the same lines serves all tests, because nothing writes to it.
    if (ini, args) not in project.found:
        # unraisableexception collects all garbage when a config ends, which is slow and not needed here.
        config = project.pytester.parseconfigure(
            "-p", "pafot", "-p", "no:unraisableexception", *args
        )
        project.found[ini, args] = config
    return resolve(project.found[ini, args], marker or {})


def test_search_without_options_repeats_itself_everywhere(project, monkeypatch):
    for value in ("", "true"):
        monkeypatch.setenv("CI", value)
        found = settings(project)
        assert (found.runs, found.generations, found.seed) == (100, None, 0)
        assert not found.isolate


@pytest.mark.parametrize(
    ("value", "expected"),
    [("true", True), ("1", True), ("", False), ("0", False), ("false", False)],
)
def test_ci_is_set_unless_empty_or_negative(value, expected):
    assert is_ci({"CI": value}) is expected


@pytest.mark.parametrize(("args", "sources", "runs", "generations"), [
    (("--pafot-generations=1",), {"marker": {"generations": 2}}, None, 1),
    ((), {"marker": {"generations": 2}, "ini": "pafot_generations = 5"}, None, 2),
    ((), {"marker": {"generations": 100}}, None, 100),
    ((), {"marker": {"runs": 7}, "ini": "pafot_generations = 3"}, 7, None),
    ((), {"ini": "pafot_generations = 100"}, None, 100),
    ((), {"marker": {"runs": 7, "generations": 2}}, 7, 2),
    ((), {"marker": {"generations": 0}}, None, 0),
])  # fmt: skip
def test_budget_comes_from_command_line_or_marker_or_ini_file_and_replaces_default(
    project, args, sources, runs, generations
):
    found = settings(project, *args, **sources)
    assert (found.runs, found.generations) == (runs, generations)


EVERYWHERE = [option for option in OPTIONS if option.everywhere]
SWITCHES = [option.name for option in EVERYWHERE if option.kind == "switch"]


def text_of(option, switch):
    """Return a text for an option that makes it differ from the others; for switches, one is on."""
    number = EVERYWHERE.index(option)
    texts = {
        "text": f"x{number}",
        "page": f"x{number}.html",
        "switch": str(option.name == switch).lower(),
    }
    return option.choices[-1] if option.choices else texts.get(option.kind, str(7 + number))


@pytest.mark.parametrize("switch", SWITCHES)
def test_options_work_as_argument_and_ini_key(project, switch):
    texts = {option.name: text_of(option, switch) for option in EVERYWHERE}
    expected = {option.name: option.read(texts[option.name]) for option in EVERYWHERE}
    arguments = {option.name: expected[option.name] for option in EVERYWHERE if option.is_argument}
    assert given(settings(project, marker=arguments), arguments) == arguments
    ini = "\n".join(f"{option.key} = {texts[option.name]}" for option in EVERYWHERE)
    assert given(settings(project, ini=ini), expected) == expected


def given(found, names):
    """Return the settings with these names."""
    return {name: getattr(found, name) for name in names}


def test_native_toml_takes_native_types(project):
    project.pytester.makefile(
        ".toml",
        pytest="[pytest]\npafot_generations = 3\npafot_max_time = 60\npafot_strict_drift = true\n",
    )
    found = settings(project, "-c", "pytest.toml")
    assert (found.generations, found.max_time, found.strict_drift) == (3, 60.0, True)


@pytest.mark.parametrize(("source", "place"), [
    ({"marker": {"generations": -1}}, "@pafot.search(generations=...): "),
    ({"ini": "pafot_workers = 5000"}, "pafot_workers: "),
    ({"ini": "pafot_generations ="}, "ini key pafot_generations: "),
    ({"ini": "pafot_isolate = perhaps"}, "ini key pafot_isolate: "),
])  # fmt: skip
def test_wrong_value_error_names_its_source(project, source, place):
    with pytest.raises(RequestError, match=re.escape(place)):
        settings(project, **source)


def test_wrong_argument_is_an_error_though_an_option_replaces_it(project):
    with pytest.raises(RequestError, match=r"@pafot.search\(generations=...\)"):
        settings(project, "--pafot-generations=5", marker={"generations": -3})


@pytest.mark.parametrize("option", ["today=31.1.2027", "json=new/"])
def test_wrong_command_line_value_is_a_usage_error(project, option):
    project.write("def test_ordinary():\n    pass\n")
    result = project.run(f"--pafot-{option}", runs=None)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert f" --pafot-{option.partition('=')[0]}: " in result.stderr.str()
    assert "\x1b" not in result.stderr.str()
    assert not (project.path / "new").exists()


def test_wrong_value_elsewhere_fails_only_marked_items(project):
    project.pytester.makeini("[pytest]\npafot_algorithm = magic\n")
    project.write(
        "@pafot.search\ndef test_marked(run):\n    pass\n\ndef test_ordinary():\n    pass\n"
    )
    project.run().assert_outcomes(errors=1, passed=1)


def test_search_arguments_match_the_table_of_options():
    own = {"world", "ads", "fitness", "blame", *SpaceArguments.__annotations__}
    options = {option.name for option in OPTIONS if option.everywhere and option.is_argument}
    assert set(SearchArguments.__annotations__) == own | options


def test_help_has_a_sentence_on_one_line_for_every_option(project, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    shown = project.run("--help", runs=None, seed=None).stdout.str()
    for option in OPTIONS:
        assert re.search(rf"^  {option.flag}\b.*\s+{re.escape(option.help)}$", shown, re.MULTILINE)
        assert re.fullmatch(r"[A-Z][a-z]+ [^.]+(\.html[^.]+)?\.", option.help), (
            "one sentence, which begins with a verb"
        )


@pytest.mark.parametrize("is_ci", [False, True])
def test_ci_is_told_of_a_policy_that_did_not_drive(project, monkeypatch, is_ci):
    skips = "@pytest.fixture\ndef ads():\n    pytest.skip('no weights')\n\n"
    project.write(skips + "@pafot.search(SHORT)\ndef test_skipped(run):\n    pass\n")
    if is_ci:
        monkeypatch.setenv("CI", "true")
    result = project.run("--pafot-json=pafot.json", runs=4)
    result.assert_outcomes(skipped=1)
    assert ["no weights" in each for each in project.record.warnings] == [True] * is_ci


def test_no_search_because_of_a_setting_is_told(project):
    project.write("@pafot.search(SHORT)\ndef test_it(run):\n    pass\n")
    project.pytester.makeini("[pytest]\npafot_generations = 0\n")
    told = ["pafot_generations is 0" in project.run(runs=runs).stdout.str() for runs in (None, 0)]
    assert told == [True, False]
