"""The options of a search, in one typed table.

Command line, ini and toml keys, ``PAFOT_*`` variables, arguments of the mark and of ``pafot.explore``, and the
reference documentation are all made from :data:`OPTIONS`. Where the values of a test come from is said in
:mod:`pytest_pafot.plugin.option_sources`.
"""

from __future__ import annotations

import difflib
import os
from argparse import ArgumentTypeError
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pytest_pafot.corpus.layout import CORPUS

if TYPE_CHECKING:
    from pytest_pafot.searching.ask_tell import Algorithm

Kind = Literal["integer", "seconds", "text", "page", "switch", "workers", "address", "folders", "day", "file", "table"]

SEED_LIMIT = 2**63

AUTO = "auto"

FULL, LOCAL = "ci", "local"

PROFILES: Mapping[str, Mapping[str, object]] = {
    FULL: {"runs": 400, "seed": 0},
    LOCAL: {"runs": 40},
}
"""``ci`` is automatic when the variable CI is set, ``local`` otherwise. ``local`` has a fresh base seed."""

BUDGETS = ("runs", "generations")
"""Options of which one that is given replaces the default of the other. Of both, the first that is used up counts."""


class OptionError(ArgumentTypeError):
    """A value that an option cannot take: its place, what was expected and received. argparse shows it as it is."""


class Option(NamedTuple):
    """One option and everything that is generated from it: ``--pafot-<name>``, ``pafot_<name>``, ``PAFOT_<NAME>``."""

    name: str
    kind: Kind
    help: str
    default: object = None
    least: float = 0  # smallest number that is accepted
    choices: tuple[str, ...] = ()  # the texts that are accepted, or nothing for any
    or_class: bool = False  # whether a class or function, or its ``module:name``, is accepted as well
    everywhere: bool = True  # False for what concerns the session and is a deliberate act: command line only
    is_argument: bool = True  # False for what concerns the session as a whole: no marker argument

    @property
    def flag(self) -> str:
        """On the command line."""
        return f"--pafot-{self.name.replace('_', '-')}"

    @property
    def key(self) -> str:
        """In ini and toml files, and the attribute of ``config.option``."""
        return f"pafot_{self.name}"

    @property
    def variable(self) -> str:
        """In the environment."""
        return f"PAFOT_{self.name.upper()}"

    @property
    def metavar(self) -> str:
        """What the help shows for a value."""
        shown = {"integer": "N", "day": "YYYY-MM-DD", "workers": "N", "page": "PATH", "folders": "DIR", "switch": ""}
        return shown.get(self.kind, self.name.upper() if self.kind == "text" else self.kind.upper())

    def read(self, value: object) -> Any:
        """The typed value of a text or of a Python value.

        Raises:
            OptionError: expected, received; without the place, which the caller knows.
        """
        if self.or_class and (not isinstance(value, str) or ":" in value):
            return value  # whoever uses it checks it: nothing is imported for options
        typed = _READERS[self.kind](self, value)
        if self.choices and typed not in self.choices:
            *others, last = self.choices
            near = difflib.get_close_matches(str(value), self.choices, n=1)
            hint = (
                "; or give a class of your own, as module:Class where only text can be given" if self.or_class else ""
            )
            hint = f"; did you mean {near[0]!r}?" if near else hint
            raise OptionError(f"expected {', '.join(others)} or {last}, received {value!r}{hint}")
        return typed


OPTIONS: tuple[Option, ...] = (
    Option(
        "runs",
        "integer",
        "Runs of each search, after which it ends, also within a generation. 40, or 400 in the profile ci, unless "
        "generations are given.",
        least=1,
    ),
    Option(
        "generations",
        "integer",
        "Generations of each search; 0 replays saved scenarios only. Without, the number of runs decides.",
    ),
    Option(
        "population",
        "integer",
        "Scenarios per generation. 16 for distinct, or 64 from the second one on where the ADS decides for many runs "
        "at once by its `batch`, of which --pafot-isolate, decision_limit and executors make no use; 4 for the others.",
        least=2,
    ),
    Option(
        "seed",
        "integer",
        "Base seed; each search derives its own from it and its node id. Fresh, or 0 in the profile ci "
        "and with --pafot-resume.",
    ),
    Option(
        "algorithm",
        "text",
        "Search algorithm: pafot is the paper's (genetic, with local fuzzer and restarts), distinct the same "
        "looking for other failures once it has found one, the others are baselines; the last three need "
        "pytest-pafot[search]. Or module:Class for an algorithm of your own.",
        default="distinct",
        choices=("distinct", "pafot", "av-fuzzer", "random", "random-manoeuvre", "nsga2", "map-elites", "cma-es"),
        or_class=True,
    ),
    Option(
        "against",
        "text",
        "A reference, such as the policy before a change: the module:factory of another ADS, or in the mark also the "
        "factory or the name of its fixture. Only what it passes is a failure then; it runs where the ADS fails.",
        or_class=True,
    ),
    Option(
        "max_time",
        "seconds",
        "End each search after so many seconds of wall-clock time, shrinking and reference drivers included: a search "
        "that has found something leaves them a third. A search that this cuts is not reproducible.",
    ),
    Option(
        "total_time",
        "seconds",
        "End the searches of the session so many seconds of wall-clock time after its start; each gets an equal "
        "share of what is left when it begins, shrinking included as with --pafot-max-time. A search that this cuts is "
        "not reproducible.",
        is_argument=False,
    ),
    Option(
        "resume",
        "text",
        "Folder of the states of searches. A search whose state is there goes on where it stopped, with its runs, "
        "generations and time counted anew, and what it finds in several sessions is what one long one finds. With "
        "distinct, random, random-manoeuvre, or an algorithm of your own that can.",
    ),
    Option("stop_after", "integer", "End each search after so many distinct findings that are new.", least=1),
    Option(
        "shrink_rollouts",
        "integer",
        "Runs that simplifying each new finding may take; 0 keeps findings as they were found. 3000 where the ADS is "
        "a vehicle class that the kernel drives, else 300.",
    ),
    Option(
        "max_saved",
        "integer",
        "Saved scenarios of each test; further new findings are counted and named, and not saved.",
        default=20,
        least=1,
    ),
    Option(
        "corpus",
        "text",
        "Folder of saved scenarios: a name beside each test file, or an absolute path for all.",
        default=CORPUS,
    ),
    Option("save", "text", "Whether new findings are written to the corpus.", default="new", choices=("new", "none")),
    Option(
        "workers",
        "workers",
        "Processes that simulate the scenarios of a generation once runs turn out to take long; auto is one for "
        "each core. What is found is the same. 1 under pytest-xdist.",
        default=1,
        least=1,
    ),
    Option(
        "isolate",
        "switch",
        "Run the ADS only in other processes, from the first run on: one that ends its process is a find, and the "
        "session goes on. What is found is the same, of an ADS with `batch` where the population is given.",
        default=False,
    ),
    Option(
        "memory",
        "integer",
        "Memory [MB] that a process of --pafot-isolate or --pafot-workers may take beyond what it begins with; 0 for "
        "any. Then allocations in it fail, which is a find. Three quarters of the machine's, shared among the workers, "
        "or 2048 where that is more. On Linux.",
    ),
    Option(
        "dask",
        "address",
        "Have the workers of the scheduler at ADDRESS simulate the scenarios of a generation; needs "
        "pytest-pafot[dask]. What is found is the same, of an ADS with `batch` where the population is given.",
        everywhere=False,
        is_argument=False,
    ),
    Option(
        "report",
        "page",
        "Write the findings to FILE.html as one web page, or to DIR/ as a page and a moving picture of each.",
    ),
    Option(
        "json",
        "file",
        "Write to FILE what the session comes to, for programs: searches, findings, their files and the exit code.",
        everywhere=False,
        is_argument=False,
    ),
    Option(
        "table",
        "table",
        "Write to FILE.csv, or FILE.parquet, a row for each scenario that the searches tried, whether it failed or "
        "not.",
        everywhere=False,
        is_argument=False,
    ),
    Option(
        "prune",
        "switch",
        "Remove saved scenarios whose test was collected and no longer exists; lists them first.",
        default=False,
        everywhere=False,
    ),
    Option(
        "merge",
        "folders",
        "Bring the saved scenarios of another machine's corpus DIR into this one, in place of searches and replays: "
        "each is run, and of each kind of failure the simplest is kept. May be given several times.",
        everywhere=False,
        is_argument=False,
    ),
    Option(
        "today",
        "day",
        "Hold the last days of accepted failures (`xfail` with `until`) against this day in place of today's, to see "
        "what will count then.",
        everywhere=False,
        is_argument=False,
    ),
    Option(
        "profile",
        "text",
        "Defaults for an occasion: ci (400 runs, seed 0; automatic when CI is set) or local.",
        choices=tuple(PROFILES),
    ),
    Option(
        "strict_drift",
        "switch",
        "Fail saved scenarios that pass under other versions than those that found them, or without that the situation "
        "of their failure came up.",
        default=False,
    ),
    Option(
        "strict_health",
        "switch",
        "Fail searches with a health warning, such as scenarios without any interaction, and a session whose saved "
        "scenarios have lost their test, as with the variable CI.",
        default=False,
    ),
    Option(
        "allow_orphans",
        "switch",
        "Let a session pass whose saved scenarios have lost their test, also under CI or --pafot-strict-health: where "
        "projects share a corpus, or a job has a part of the tests. The summary names them all the same.",
        default=False,
        is_argument=False,
    ),
)

BY_NAME: Mapping[str, Option] = {option.name: option for option in OPTIONS}


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The value of every option for one item. ``seed`` is the base seed."""

    runs: int | None
    generations: int | None
    population: int | None  # the algorithm's own where it is None
    seed: int
    algorithm: str | type[Algorithm[Any]]
    against: str | Callable[..., Any] | None
    max_time: float | None
    total_time: float | None
    resume: str | None
    stop_after: int | None
    shrink_rollouts: int | None  # by the kind of ADS where it is None
    max_saved: int
    corpus: str
    save: str
    workers: int
    isolate: bool
    memory: int | None  # by the machine where it is None
    report: str | None
    profile: str
    strict_drift: bool
    strict_health: bool
    allow_orphans: bool

    @property
    def is_search(self) -> bool:
        """Whether there is anything to do beside the replays."""
        return self.generations != 0

    @property
    def budget(self) -> str:
        """The options by which as long a search is asked for."""
        given = ((BY_NAME[name].flag, getattr(self, name)) for name in BUDGETS)
        return " ".join(f"{flag}={value}" for flag, value in given if value is not None)


def is_ci(environ: Mapping[str, str]) -> bool:
    """Whether the profile ``ci`` is automatic: CI is set to anything but an empty text, 0 or false."""
    return environ.get("CI", "").lower() not in ("", "0", "false")


def _read_integer(option: Option, value: object) -> int:
    try:
        number = int(value, 10) if isinstance(value, str) else value
    except ValueError:
        number = None
    if isinstance(number, bool) or not isinstance(number, int) or not option.least <= number < SEED_LIMIT:
        limit = f" and less than {SEED_LIMIT}" if isinstance(number, int) and number >= SEED_LIMIT else ""
        raise OptionError(f"expected a whole number, at least {option.least:g}{limit}, received {value!r}")
    return number


def _read_workers(option: Option, value: object) -> int:
    if value == AUTO:
        return cores()
    try:
        return _read_integer(option, value)
    except OptionError:
        raise OptionError(f"expected {AUTO} or a whole number, at least {option.least:g}, received {value!r}") from None


def cores() -> int:
    """Those that this process may use, at least one."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _read_seconds(option: Option, value: object) -> float:
    try:
        seconds = float(value) if isinstance(value, (str, int, float)) and not isinstance(value, bool) else -1.0
    except ValueError:
        seconds = -1.0
    if not option.least <= seconds < float("inf"):
        raise OptionError(f"expected seconds, at least {option.least:g}, received {value!r}")
    return seconds


def _read_text(option: Option, value: object) -> str:
    if not isinstance(value, (str, os.PathLike)) or not os.fspath(value):
        raise OptionError(f"expected a text, received {value!r}")
    return str(os.fspath(value))


def _read_day(option: Option, value: object) -> str:
    from pytest_pafot.support.text import day_of  # noqa: PLC0415  (for few sessions)

    if not isinstance(value, str) or day_of(value) is None:
        raise OptionError(f"expected a day of the calendar, as 2027-01-31, received {value!r}")
    return value


def _read_page(option: Option, value: object) -> str:
    text = _read_text(option, value)
    if is_page_file(text) or text.endswith(("/", "\\")) or not PurePath(text).suffix:
        return text
    raise OptionError(f"expected the name of a page FILE.html, or of a folder DIR/, received {value!r}")


def _read_file(option: Option, value: object) -> str:
    text = _read_text(option, value)
    if text.endswith(("/", "\\")):
        raise OptionError(f"expected the name of a file, received {value!r}, a folder; give {text}pafot.json")
    return text


def _read_table(option: Option, value: object) -> str:
    text = _read_text(option, value)
    if PurePath(text).suffix.lower() not in (".csv", ".parquet"):
        raise OptionError(f"expected the name of a file FILE.csv or FILE.parquet, received {value!r}")
    return text


def is_page_file(text: str) -> bool:
    """Whether the option ``report`` names a file, rather than a folder."""
    return text.lower().endswith((".html", ".htm"))


def _read_switch(option: Option, value: object) -> bool:
    if isinstance(value, bool):
        return value
    words = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False, "no": False, "off": False}
    word = value.lower() if isinstance(value, str) else None
    if word not in words:
        raise OptionError(f"expected true or false, received {value!r}")
    return words[word]


_READERS: Mapping[Kind, Callable[[Option, object], Any]] = {
    "integer": _read_integer,
    "seconds": _read_seconds,
    "text": _read_text,
    "page": _read_page,
    "switch": _read_switch,
    "workers": _read_workers,
    "address": _read_text,
    "folders": _read_text,
    "day": _read_day,
    "file": _read_file,
    "table": _read_table,
}
