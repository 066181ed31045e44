"""The options of the plugin, in one typed table."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

from pytest_pafot.corpus.layout import CORPUS
from pytest_pafot.support.errors import RequestError, flag, install

if TYPE_CHECKING:
    from pytest_pafot.algorithms.plan import Algorithm

Kind = Literal[
    "integer", "seconds", "text", "page", "switch", "workers", "address", "day", "file"
]  # fmt: skip

# The names of the built-in search algorithms.
AlgorithmName = Literal["random", "pafot", "av-fuzzer", "random-manoeuvre"]

SEED_LIMIT = 2**63

# The largest number of processes that can be requested. More would not fit into the memory of any machine today.
MOST_WORKERS = 1024

# The environment variable with which a command passes its policy to the pytest session that it starts.
OF_COMMAND = "PYTEST_PAFOT_POLICY"

AUTO = "auto"

# The options that limit a search. If both are given, the lower limit applies.
BUDGETS = ("runs", "generations")

RUNS = 100  # the number of runs of a search without a budget


class Option(NamedTuple):
    """An option of the plugin."""

    name: str
    kind: Kind
    help: str  # one sentence, for the terminal and the reference documentation
    details: str = ""  # more text for the reference documentation, in Markdown
    default: object = None
    least: float = 0  # the smallest accepted number
    most: float = SEED_LIMIT - 1  # the largest accepted whole number
    choices: tuple[str, ...] = ()  # the accepted strings; empty if any string is accepted
    # True if a class or function, or its ``module:name``, is accepted as well
    or_class: bool = False
    # False if it applies to a single session, so that only the command line accepts it
    everywhere: bool = True
    # False for an option of the whole session, which is not an argument of the mark
    is_argument: bool = True

    @property
    def flag(self) -> str:
        """The name on the command line, such as ``--pafot-max-time``."""
        return flag(self.name)

    @property
    def key(self) -> str:
        """The key in ini and toml files, and in ``config.option``."""
        return f"pafot_{self.name}"

    @property
    def metavar(self) -> str:
        """The placeholder in the help, such as ``SECONDS``."""
        shown = {
            "integer": "N",
            "day": "YYYY-MM-DD",
            "workers": "N",
            "page": "FILE.html",
            "switch": "",
        }
        return shown.get(self.kind, self.name.upper() if self.kind == "text" else self.kind.upper())

    def read(self, value: object) -> Any:
        """Convert a string or a Python value to the type of the option.

        Raises:
            RequestError: if the value is invalid. The caller adds the value's source to the message.
        """
        if self.or_class and (not isinstance(value, str) or ":" in value):
            return value  # checked where it is used, since reading options must not import anything
        typed = _READERS[self.kind](self, value)
        if self.choices and typed not in self.choices:
            *others, last = self.choices
            hint = ""
            if self.or_class:
                hint = ". For your own class, write module:Class, or pass the class in Python"
            from pytest_pafot.support.text import suggest  # noqa: PLC0415  (for few sessions)

            hint = suggest(value, self.choices) or hint
            raise RequestError(f"expected {', '.join(others)} or {last}, received {value!r}{hint}")
        return typed


def option(
    kind: Kind, text: str, details: str = "", *, default: object = None, **known: Any
) -> Any:
    """Return a field for :class:`Settings`. Keyword arguments are fields of :class:`Option`."""
    return field(
        default=default, metadata={"kind": kind, "help": text, "details": details, **known}
    )


# Command-line options, ini and toml keys, arguments of the mark and of `pafot.explore`, and the reference documentation
# are generated from these fields. `plugin/session.py` defines the precedence of the sources of a value. The dataclass
# generates few methods, because methods of so many fields would delay the start of each pytest session.
@dataclass(frozen=True, slots=True, kw_only=True, init=False, repr=False, eq=False)
class Settings:
    """The plugin's options, with their types, help texts and defaults.

    An instance contains the values for one item.
    """

    # Only the controller reads options that apply to a single session (`everywhere=False`). Items have their defaults.

    runs: int | None = option(
        "integer",
        "Stop each search after N runs; with 0, only replay.",
        f"The default is {RUNS}, or no limit with `--pafot-generations`.",
    )
    generations: int | None = option(
        "integer",
        "Stop each search after N generations.",
        "Only algorithms that breed have generations, so the default algorithm is then `pafot`, the genetic algorithm "
        "from the paper. 0 only replays saved scenarios.",
    )
    seed: int = option(
        "integer",
        "Derive the seed of each search from the base seed N.",
        "A different base seed generates different scenarios.",
        default=0,
    )
    algorithm: AlgorithmName | type[Algorithm[Any]] | None = option(  # noqa: RUF009  (it returns a field)
        "text",
        "Search with a built-in algorithm or with module:Class.",
        "The default is `random`, or `pafot` with `--pafot-generations`. See [Algorithms](../guide/algorithms.md).",
        choices=get_args(AlgorithmName),
        or_class=True,
    )
    against: str | Callable[..., Any] | None = option(  # noqa: RUF009  (it returns a field)
        "text",
        "Count a failure only if policy module:factory passes.",
        "The other policy is the *reference*, for example [an earlier version](../guide/ci.md). `@pafot.search` also "
        "accepts a factory, or the name of a fixture that returns one.",
        or_class=True,
    )
    max_time: float | None = option(
        "seconds",
        "Stop each search after SECONDS of wall-clock time.",
        "A search with findings reserves at most a third of this time for processing them. A search that reaches "
        "the limit is not reproducible.",
        is_argument=False,
    )
    stop_after: int | None = option(
        "integer", "Stop each search after N distinct new findings.", least=1, is_argument=False
    )
    shrink_runs: int | None = option(
        "integer",
        "Use at most N runs to shrink each new finding.",
        "0 saves findings without shrinking. The default is 3000 for vehicle classes that the kernel drives, and 300 "
        "for other policies. By default, processing also stops after as many decisions of the policy as the "
        "search made, but not before 2000.",
    )
    corpus: str = option(
        "text",
        "Save scenarios in this folder next to each test file.",
        "An absolute path specifies one folder for all tests.",
        default=CORPUS,
        is_argument=False,
    )
    save: str = option(
        "text",
        "Save new findings (new) or nothing (none).",
        default="new",
        choices=("new", "none"),
        is_argument=False,
    )
    workers: int = option(
        "workers",
        "Run scenarios in N processes (auto: one per core).",
        "Replays and shrinking run in the main process. The findings stay the same. Under pytest-xdist, N is 1.",
        default=1,
        least=1,
        most=MOST_WORKERS,
        is_argument=False,
    )
    isolate: bool = option(
        "switch",
        "Report a finding if an ADS ends its process.",
        "The policy then runs only in [separate processes](../guide/planners.md).",
        default=False,
    )
    dask: str | None = option(
        "address",
        "Run scenarios on the workers of a Dask scheduler.",
        f"To install Dask, run `{install('dask')}`.",
        everywhere=False,
        is_argument=False,
    )
    report: str | None = option(
        "page",
        "Write the findings to FILE.html as a single web page.",
        "If there are more than 100 findings, the page shows the worst 100 in full and lists the others.",
        is_argument=False,
    )
    json: str | None = option(
        "file",
        "Write the results of the session to FILE as JSON.",
        "The file has [these keys](files.md#results-as-json).",
        everywhere=False,
        is_argument=False,
    )
    today: str | None = option(
        "day",
        "Decide whether acceptances have expired as of this day.",
        "The default is the current day.",
        everywhere=False,
        is_argument=False,
    )
    debug: bool = option(
        "switch",
        "Open the debugger at the decisive moment of a replay.",
        "This moment is the policy's last decision that [could have avoided the failure](../explanation/findings.md). "
        "Enter `s` to step into the policy. This works only for `pytest FILE` in one process.",
        default=False,
        is_argument=False,
    )
    strict_drift: bool = option(
        "switch",
        "Fail saved scenarios that pass but have drifted.",
        "They may [no longer test the failure](../guide/triage.md) for which they were saved.",
        default=False,
        is_argument=False,
    )
    strict_health: bool = option(
        "switch",
        "Fail searches with a health warning.",
        "For example, there is a warning if most runs had no interaction with an NPC. A session that skips saved "
        "scenarios also fails, as it does with the environment variable `CI`.",
        default=False,
        is_argument=False,
    )
    allow_orphans: bool = option(
        "switch",
        "Allow sessions that do not run all saved scenarios.",
        "This takes precedence over `CI` and `--pafot-strict-health`.",
        default=False,
        is_argument=False,
    )

    def __init__(self, **given: Any) -> None:
        for name, value in ({each.name: each.default for each in fields(self)} | given).items():
            # raises an error for an unknown name, which has no slot
            object.__setattr__(self, name, value)

    @property
    def is_search(self) -> bool:
        """True if the settings request a search and not only replays."""
        return 0 not in (self.runs, self.generations)

    @property
    def repeated(self) -> list[str]:
        """The command-line options that request the same search."""
        return [
            flag(name, value)
            for name in (*BUDGETS, "seed")
            if (value := getattr(self, name)) is not None
        ]


OPTIONS: tuple[Option, ...] = tuple(
    Option(each.name, default=each.default, **each.metadata)
    for each in fields(Settings)
    if each.metadata
)

BY_NAME: Mapping[str, Option] = {each.name: each for each in OPTIONS}


def is_ci(environ: Mapping[str, str]) -> bool:
    """Return whether the environment variable CI is set to anything but 0 or false."""
    return environ.get("CI", "").lower() not in ("", "0", "false")


def _read_integer(option: Option, value: object) -> int:
    try:
        number = int(value, 10) if isinstance(value, str) else value
    except ValueError:
        number = None
    # In Python, True is the number 1, but nobody asks for True runs.
    if isinstance(number, int) and not isinstance(number, bool):
        if option.least <= number <= option.most:
            return number
        limit = f" and at most {option.most}" if number > option.most else ""
    else:
        limit = ""
    raise RequestError(
        f"expected a whole number, at least {option.least:g}{limit}, received {value!r}"
    )


def _read_workers(option: Option, value: object) -> int:
    if value == AUTO:
        from pytest_pafot.support.process import cores  # noqa: PLC0415  (slow to import)

        return cores()
    try:
        return _read_integer(option, value)
    except RequestError as error:
        raise RequestError(str(error).replace("expected a", f"expected {AUTO} or a", 1)) from None


def _read_seconds(option: Option, value: object) -> float:
    # A value that is no number is reported as one that is out of range, with what is expected.
    seconds = -1.0
    if isinstance(value, (str, int, float)) and not isinstance(value, bool):
        with suppress(ValueError):
            seconds = float(value)
    if not option.least <= seconds < float("inf"):
        raise RequestError(
            f"expected a number of seconds, at least {option.least:g}, received {value!r}"
        )
    return seconds


def _read_text(option: Option, value: object) -> str:
    if not isinstance(value, (str, os.PathLike)) or not os.fspath(value):
        raise RequestError(f"expected a string, received {value!r}")
    return str(os.fspath(value))


def _read_day(option: Option, value: object) -> str:
    from pytest_pafot.support.text import day_of  # noqa: PLC0415  (for few sessions)

    if not isinstance(value, str) or day_of(value) is None:
        raise RequestError(f"expected a date such as 2027-01-31, received {value!r}")
    return value


def _read_page(option: Option, value: object) -> str:
    from pytest_pafot.support.files import is_stream  # noqa: PLC0415  (only for sessions with a page)

    text = _read_text(option, value)
    if text.lower().endswith((".html", ".htm")) or is_stream(Path(text)):
        return text
    raise RequestError(f"expected a file name such as FILE.html, received {value!r}")


def _read_file(option: Option, value: object) -> str:
    text = _read_text(option, value)
    if text.endswith(("/", "\\")):
        raise RequestError(
            f"expected the name of a file, received {value!r}, which is a folder. Use {text}pafot.json"
        )
    return text


def _read_switch(option: Option, value: object) -> bool:
    if isinstance(value, bool):
        return value
    words = {
        "1": True,
        "true": True,
        "yes": True,
        "on": True,
        "0": False,
        "false": False,
        "no": False,
        "off": False,
    }
    word = value.lower() if isinstance(value, str) else None
    if word not in words:
        raise RequestError(f"expected true or false, received {value!r}")
    return words[word]


_READERS: Mapping[Kind, Callable[[Option, object], Any]] = {
    "integer": _read_integer,
    "seconds": _read_seconds,
    "text": _read_text,
    "page": _read_page,
    "switch": _read_switch,
    "workers": _read_workers,
    "address": _read_text,
    "day": _read_day,
    "file": _read_file,
}
