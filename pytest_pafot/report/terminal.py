"""The plugin's output in the terminal: progress, findings, failures of searches, and the session's summary.

Lines are ASCII and fit the width of the terminal, except for node ids, paths and the user's own words.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

from pytest_pafot.algorithms.plain import from_plain
from pytest_pafot.attribution.sentences import AT_FAULT
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.shrink import described
from pytest_pafot.findings.sighting import NOT_REPEATED, Seen
from pytest_pafot.findings.verdict import worsening
from pytest_pafot.model.trace import SURVIVES, WORLD_HANG, Outcome
from pytest_pafot.report.session import UNNAMED_ADVICE, Session
from pytest_pafot.searches.events import UNTESTED, Ending, Note, Progress, Search
from pytest_pafot.support.errors import OF_SEARCH, command, flag
from pytest_pafot.support.proportions import interval_text
from pytest_pafot.support.text import (
    ascii_text,
    capitalised,
    fitted_lines,
    listed,
    plural,
    wrapped_to,
)

Event = Progress | Search | Seen | Note
"""An event that an item sends to the session's record."""

WIDTH = 80
MINUTE, HOUR = 60, 3600
# If more time than this [s] is left, the progress line names the option that limits it.
LONG = 600
# The maximum number of lines in the block on a failure, at 80 columns and without the title.
ROOM = 11
# The keys that count failed random scenarios.
FAILING = ("at_fault", "otherwise")
# The maximum lengths of lists: a search's kinds of failures, its new findings, findings that annotate a CI job, saved
# scenarios that were not replayed, and replays that need attention.
MAX_KINDS = 3
MAX_FINDS = 20
MAX_ANNOTATED = 5
MAX_LEFT = 5
MAX_REPLAYS = 10
# Why a search ended early, as the end of a sentence after "because". Unknown reasons are missing.
WHY = {Ending.FINDINGS: "it had enough findings", Ending.REPLAYS: "it only replayed", Ending.ERROR: "of an error",
       Ending.INTERRUPTED: "it was interrupted", Ending.MAX_TIME: f"of {Ending.MAX_TIME}"}  # fmt: skip


BEST_ACTION = (
    "or make a model take its best action (in Stable-Baselines3: predict(..., deterministic=True))"
)
DRAWS = f"the policy probably has its own random generator. Seed it in the factory of the policy, {BEST_ACTION}"
DRAWS_IN_WRAPPERS = (
    "the policy or a wrapper probably has its own random generator. In a wrapper, draw from self.np_random. Seed the "
    f"generator of a policy in its factory, {BEST_ACTION}"
)


def progress_line(progress: Progress, width: int = WIDTH) -> str:
    """Return a progress line. If it is too long, shorten the node id first and then the end."""
    speed = progress.runs / progress.seconds if progress.seconds > 0 else 0.0
    pace = f"{1 / speed:.0f} s per run" if 0 < speed < 1 else f"{plural(round(speed), 'run')}/s"
    counts = (
        [f"{progress.generation}/{progress.generations} generations"]
        if progress.generations is not None
        else []
    )
    counts += [
        plural(progress.runs, "run")
        if progress.budget is None
        else f"{progress.runs}/{progress.budget} runs"
    ]
    # If more than a minute is left, show how long. If much more is left, also show how to limit it.
    seconds, left = progress.left, ""
    if seconds >= MINUTE:
        duration = (
            f"{seconds / HOUR:.1f} h" if seconds >= 2 * HOUR else f"{seconds / MINUTE:.0f} min"
        )
        each = (
            f" at {1000 * progress.decision_seconds:.3g} ms per decision"
            if progress.decision_seconds
            else ""
        )
        way_out = (
            ""
            if progress.is_limited or seconds < LONG
            else f"; limit it with {flag('max_time', LONG)}"
        )
        left = f", about {duration} left{each}{way_out}"
    done = f"{', '.join(counts)}, {progress.failing} failed, {progress.finds} new, {pace}{left}"
    tail = f" {progress.phase or done}"
    room = max(12, width - len(tail) - 8)
    name = ascii_text(progress.node_id)
    name = name if len(name) <= room else f"...{name[3 - room :]}"
    return f"pafot: {name}{tail}"[:width]


def found_line(seen: Seen) -> str:
    """Return the line that announces a new finding while the search continues."""
    expect = seen.finding.expect
    kinds = {
        "collision": "a collision",
        "ads_error": "an error in the policy",
        "hang": "a hang in the policy",
    }
    what = kinds.get(expect.outcome, "a failure")
    if (expect.is_crash and expect.outcome is not Outcome.HANG) or expect.signature.is_property:
        what = (
            "a process crash"
            if expect.is_crash
            else "a failed check"
            if expect.check
            else "a failed assertion"
        )
    return ascii_text(
        f"pafot: found {what}: {seen.node_id}{'' if seen.path else f', not saved: {seen.detail}'}"
    )


def describe_failure(seen: Seen) -> list[str]:
    """Describe what happened, in the same words for all reports: headline, sentences and decision."""
    expect, sentences = seen.finding.expect, seen.observed.sentences
    headline = seen.headline
    for fault in AT_FAULT.values() if sentences else ():  # The sentences state it.
        headline = headline.replace(f"; {fault}", "")
    what = "The check fails: " if expect.check and seen.is_as_saved else ""
    parts = [f"{what}{headline}{'' if headline.endswith(('.', '?')) else '.'}"]
    if expect.outcome in ("ads_error", "hang") and not expect.check and seen.is_as_saved:
        # The last frame in the policy: its two lines, without the markers below them.
        lines = [line.rstrip() for line in expect.traceback.splitlines() if line.startswith("  ")]
        who = "environment" if headline.startswith(WORLD_HANG) else "policy"
        parts[0] = f"The {who} failed after {expect.time:.1f} s: {parts[0]}"
        parts += [line for line in lines if line.strip(" ~^")][-2:]
    return [*parts, *sentences, *([] if seen.moment is None else [seen.moment.brief])]


def block_lines(
    seen: Seen,
    again: str,
    *,
    search: Search | None = None,
    place: str = "",
    text: str = "",
    width: int = WIDTH,
    is_whole: bool = False,
) -> list[str]:
    """Return the block about a failure, with at most twelve lines at 80 columns, including its title.

    Args:
        seen: the failure.
        again: the command that replays the failure.
        search: the search that found it; None if unknown.
        place: where the test failed, such as ``test_a.py:12``.
        text: pytest's message about the failure.
        width: width of the terminal in columns.
        is_whole: whether the block contains all known details.
    """
    finding, moment, now = seen.finding, seen.moment, seen.observed
    runs = search.runs if search is not None and now.new else 0
    first, *others = describe_failure(seen)
    # Each text has a number. Texts with 0 must stay. Texts with the largest numbers are omitted first: a condition of
    # several lines, the number of similar runs, which the summary repeats, the ego's actions, and then the policy's
    # condition and decision.
    parts: list[tuple[int, str]] = []
    expect, message = (
        finding.expect,
        next(iter(text.splitlines()), "").removeprefix("AssertionError: "),
    )
    # A replay can fail in a different way than its file.
    if expect.is_crash and text and seen.is_as_saved:
        first, place = (
            f"{capitalised(' '.join(text.removeprefix('Failed: ').split())).removesuffix('.')}.",
            "",
        )
    place = (
        place if expect.check is None and (expect.signature.is_property or expect.is_crash) else ""
    )
    if place and message not in first and not seen.is_flaky:
        parts = [(0, f"{place}: {message}{f' ({expect.assertion})' if expect.assertion else ''}.")]
    parts += [(0, f"{'' if parts or not place else f'{place}: '}{first}")]
    ranks = dict(zip(now.sentences[-2:][::-1], (0, 9), strict=False)) | (
        {moment.brief: 7} if moment else {}
    )
    parts += [(ranks.get(text, 5), text) for text in others]
    if moment is not None and is_whole:
        parts[-1] = 0, str(moment)
        parts += [(0, f"  {line}") for line in moment.condition_lines()]
    elif moment is not None:
        # Without a difference, only a condition on this NPC is relevant. Others may be about an empty row, for example.
        about = None if moment.otherwise or moment.reference else f"NPC {moment.npc}"
        row = next(
            (
                f"  {row}"
                for whom, group in moment.conditions
                if about in (None, whom)
                for row in group
            ),
            "",
        )
        parts += [(11 if len(row) > WIDTH else 8, row)] if row else []
    parts += [(4, f"{capitalised(text)}.") for text in _remarks_on(seen)]
    parts += [(0, f"It was simplified {how}.") for how in shrunk_lines(finding) if is_whole]
    like = f"{1 + seen.alike.runs} of {runs} runs" if seen.alike.runs else "no other run"
    worst = (
        capitalised(seen.worst)
        if seen.alike.runs or not seen.worst
        else f"The original run {seen.alike.severity}"
    )
    parts += (
        [(10, f"{capitalised(like)} failed in the same way{worst and f'. {worst}'}.")]
        if runs > 1
        else []
    )
    parts += (
        [(1, f"The reference {finding.expect.against} passes this scenario.")]
        if finding.expect.against
        else []
    )
    if not now.new:
        parts.append(
            (1, f"Result of the replay: {seen.label}{seen.detail and f' ({seen.detail})'}.")
        )
    elif seen.detail:
        parts.append(
            (
                0,
                f"The saved file {seen.detail}."
                if seen.path
                else f"It was not saved: {seen.detail}.",
            )
        )
    if now.beyond:
        accepts = f"The line `xfail:` in {seen.path} accepts `{expect.brief}`, but this failure differs: {now.beyond}"
        way_out = "Correct the policy, or delete the file, search again and accept the new finding"
        parts.append((0, f"The failure is not accepted. {accepts}. {way_out}."))
    while not is_whole and sum(
        len(wrapped_to(ascii_text(text), WIDTH)) for _, text in parts
    ) > ROOM - bool(again):
        spared = max(parts, key=lambda part: part[0])
        if not spared[0]:
            break
        parts.remove(spared)
    lines = fitted_lines([ascii_text(text) for _, text in parts], width)
    if not seen.path and seen.detail != flag("save", "none"):
        lines += [
            "The file would contain:",
            *(ascii_text(f"  {line}") for line in text_of(finding).splitlines()),
        ]
    # The command is not wrapped, so that it can be copied.
    return [*lines, *([ascii_text(f"replay {again}")] if again else [])]


def _remarks_on(seen: Seen) -> list[str]:
    advice = "it was not simplified, because its runs differ" if seen.is_flaky else ""
    flaky, has_wrappers = seen.finding.flaky or "", bool(seen.finding.world.get("wrappers"))
    # State that survives in the world is not a random generator of the policy.
    if flaky.startswith(NOT_REPEATED) and (has_wrappers or SURVIVES not in flaky):
        advice = DRAWS_IN_WRAPPERS if has_wrappers else DRAWS
    return [text for text in (". ".join(map(capitalised, seen.remark.split("; "))), advice) if text]


def shrunk_lines(finding: Finding) -> list[str]:
    """Return a line about how a finding was simplified, if it was."""
    if finding.shrunk is None or not finding.shrunk.before:
        return []
    sizes = [
        each.split(", ")
        for each in (finding.shrunk.before, described(finding.scenario, finding.longest_run))
    ]
    changed = [pair for pair in zip(*sizes, strict=True) if pair[0] != pair[1]]
    how = f"from {', '.join(old for old, _ in changed)} to {', '.join(new for _, new in changed)}"
    how = how if changed else "to a simpler scenario of the same size"
    return [how if finding.shrunk.is_minimal else f"{how}; a simpler scenario may exist"]


def event_of(kind: str, text: str) -> Event:
    """Build an event from the name of its class and its JSON."""
    kinds: dict[str, type[Event]] = {each.__name__: each for each in (Progress, Search, Seen, Note)}
    return from_plain(kinds[kind], json.loads(text))


def ranked(findings: Iterable[Seen]) -> list[Seen]:
    """Return findings with the worst first."""
    return sorted(findings, key=lambda each: each.rank)


def failure_message(search: Search) -> str:
    """Return the reason why a search's item fails."""
    names = [f"{each.id}{' (flaky)' if each.is_flaky else ''}" for each in ranked(search.finds)]
    return f"{plural(len(names), 'new failure')} in {plural(search.runs, 'run')}: {_listed(names)}"


def search_lines(search: Search, *, width: int = WIDTH, is_whole: bool = False) -> list[str]:
    """Summarise a search in at most eight lines at 80 columns. Warnings and ``is_whole`` add lines."""
    finds, kinds, more, random = ranked(search.finds), search.kinds, search.more_runs, search.random
    drawn, failing = random["runs"], sum(random[each] for each in FAILING)
    # Omit the proportion if the reference failed in some runs, because these count as failures of random scenarios.
    share = interval_text(failing, drawn) if drawn and not kinds["common"] else ""
    others = (
        (kinds["npc"], "an NPC was responsible"),
        (kinds["common"], "the reference also failed"),
    )
    first = f"{kinds['failed'] or 'none'} of {plural(search.runs, 'run')} failed"
    evaluated = search.runs - sum(kinds[kind] for kind in UNTESTED)
    # All scenarios were drawn at random.
    if drawn and (drawn, failing) == (evaluated, kinds["failed"]):
        first, share = (
            f"{failing or 'none'} of {plural(drawn, 'random scenario')} failed: {share}",
            "",
        )
    texts = [
        "; ".join(
            [first, *(f"in {plural(count, 'other')}, {what}" for count, what in others if count)]
        )
    ]
    rows = [
        (each.id, 1 + each.alike.runs, each.impacts, "new, flaky" if each.is_flaky else "new")
        for each in finds
    ]
    rows += [(id_, count, "", "known") for id_, count in sorted(search.known.items())]
    shown = rows if is_whole or len(rows) <= MAX_KINDS else rows[: MAX_KINDS - 1]
    texts += [
        f"{id_}: {plural(count, 'run')}{impacts} ({what})" for id_, count, impacts, what in shown
    ]
    texts += [f"{len(rows) - len(shown)} more kinds of failures"] if len(rows) > len(shown) else []
    texts += (
        [f"{failing or 'None'} of {plural(drawn, 'random scenario')} failed: {share}"]
        if share
        else []
    )
    untested = listed([f"{kinds[kind]} {kind}" for kind in UNTESTED if kinds[kind]])
    several = [plural(search.runs, "run") + (f" ({untested})" if untested else "")]
    several += [f"{plural(more['known'], 'scenario')} with a known result"] if more["known"] else []
    several += (
        [f"{count} more to analyse failures"] if (count := more["shrink"] + more["moment"]) else []
    )
    several += [f"{count:,} decisions"] if (count := search.decisions.total()) else []
    # A session may have hundreds of searches without a failure, so each of them takes only one line.
    is_quiet = evaluated and search.reason.is_complete and not (search.failing or finds or is_whole)
    texts += [] if is_quiet else [f"{listed(several)} took {search.seconds:.1f} s"]
    if not search.reason.is_complete:
        made = {"generations": search.generations, "runs": search.runs}
        left = [
            f"{made[what]} of {most} {what}"
            for what, most in search.asked.items()
            if made[what] < most
        ]
        because = f", because {WHY[search.reason]}" if search.reason else ""
        texts.append(f"The search ended early{', after ' if left else ''}{listed(left)}{because}")
    folders = " and ".join(dict.fromkeys(os.path.dirname(each.path) for each in finds if each.path))  # noqa: PTH120
    texts += (
        [f"Saved in {folders}" + ". Commit the files" * (not os.environ.get(OF_SEARCH))]
        if folders
        else []
    )
    texts += [
        f"Not saved: {each}"
        for each in dict.fromkeys(each.detail for each in finds if not each.path)
    ]
    texts += [capitalised(search.compared)] if search.compared else []
    if search.no_worse:
        names = [
            f"{id_} ({headline})" if headline else id_ for id_, headline in search.no_worse.items()
        ]
        texts.append(
            f"Not counted, because the reference fails as often in other scenarios: {_listed(names)}"
        )
    if is_whole:
        texts += (
            [f"{search.no_interaction} of these runs had no interaction"]
            if search.no_interaction
            else []
        )
        texts += (
            []
            if search.reached is None
            else [f"NPCs reached {100 * search.reached:.0f} % of their goals"]
        )
        texts += [capitalised(search.drawn)] if search.drawn else []
        texts.append(
            f"Algorithm: {search.algorithm}, with seed {search.seed} from {flag('seed', search.base_seed)}"
        )
    head = wrapped_to(ascii_text(f"{search.node_id}: {texts[0]}."), width)
    said = [*(f"{text}." for text in texts[1:]), *_remarks(search)]
    return [*head, *(line for text in said for line in _wrapped(text, width))]


def _remarks(search: Search) -> list[str]:
    notes = (*search.process_notes, *search.notes)
    return [*(f"warning: {text}" for text in search.warnings), *(f"note: {text}" for text in notes)]


def replay_lines(replays: Sequence[Seen], width: int = WIDTH) -> list[str]:
    """Return lines with the number of replays for each result, and then the replays that need attention."""
    if not replays:
        return []
    counts = sorted(Counter(replay.result for replay in replays).items())
    figures = ", ".join(f"{count} {result}" for result, count in counts)
    lines = wrapped_to(f"replayed {plural(len(replays), 'saved scenario')}: {figures}", width)
    shown = [
        each for each in replays if each.result != "still failing" or each.compared == "introduced"
    ]
    for replay in shown[:MAX_REPLAYS]:
        lines.append(f"  {replay.result}: {replay.node_id}")
        remarks = "; ".join(filter(None, [replay.on_search, replay.detail]))
        lines += [f"  {line}" for line in _wrapped(remarks, width - 2)] if remarks else []
    return (
        [*lines, f"  ... and {len(shown) - MAX_REPLAYS} more"]
        if len(shown) > MAX_REPLAYS
        else lines
    )


def against_lines(session: Session, width: int = WIDTH) -> list[str]:
    """Count the failures that the policy introduces, that it fixes and that both have, for each reference."""
    lines: list[str] = []
    if session.incomparable:  # otherwise, the counts would be incomplete
        return lines
    replays = session.replays
    names = [
        *(each.against for each in session.ended),
        *(each.observed.against for each in replays),
    ]
    for name in filter(None, dict.fromkeys(names)):
        own = [each for each in replays if each.observed.against == name]
        counts = Counter(replay.compared for replay in own)
        found = sum(len(each.finds) for each in session.ended if each.against == name)
        introduced = plural(found + counts["introduced"], "failure")
        text = f"compared with {name}: {introduced} introduced, {counts['fixed']} fixed, {counts['common']} unchanged"
        elsewhere = sum(len(each.no_worse) for each in session.ended if each.against == name)
        text += f", {elsewhere} in other scenarios" if elsewhere else ""
        lines += wrapped_to(text, width)
        common = [each for each in own if each.compared == "common"]
        changes = [(each.id, worsening(each.severity, each.observed.before)) for each in common]
        worse = [f"{id_} {change}" for id_, change in changes if change]
        if worse:
            count = f"{len(worse)} of {plural(len(common), 'unchanged failure')} became worse"
            lines += wrapped_to(f"{count}: {'; '.join(worse[:MAX_REPLAYS])}", width)
    return lines


def session_lines(session: Session, *, width: int = WIDTH, is_whole: bool = False) -> list[str]:
    """Return the summary of a session as lines, or no lines if there is nothing to report."""
    lines, drawn = list[str](), set[str]()
    # Describe a range of scenarios only once, even if several searches share it.
    for search in session.ended:
        new = replace(search, drawn="") if search.drawn in drawn else search
        lines += search_lines(new, width=width, is_whole=is_whole)
        drawn.add(search.drawn)
    for node_id in session.running:
        lines += [node_id, *_wrapped("did not finish; its findings so far are reported", width)]
    lines += replay_lines(session.replays, width)
    lines += against_lines(session, width)
    lines += [
        f"not run: {test}: pytest does not collect it. {UNNAMED_ADVICE}" for test in session.unnamed
    ]
    if session.left:
        lines.append(
            f"not run: {plural(len(session.left), 'saved scenario')}: {_listed(session.left, MAX_LEFT)}"
        )
    # The command `search` prints its own advice.
    if any(find.path for find in session.finds) and not os.environ.get(OF_SEARCH):
        seeds = dict.fromkeys(
            f"pytest {flag('seed', each.base_seed)}" for each in session.ended if each.finds
        )
        again = f"{' or '.join(seeds)} repeats {'this search' if len(session.ended) == 1 else 'the searches'}"
        replay = " ".join(["pytest", *session.options, flag("runs", 0)])
        lines += wrapped_to(f"{replay} replays the saved scenarios, and {again}.", width)
    lines += [line for text in session.written for line in text.splitlines()]
    warnings = sorted(set(session.warnings))
    for kind, texts in (
        ("warning", warnings),
        ("note", session.notes),
        ("problem", session.problems),
    ):
        for text in texts:
            lines += _wrapped(f"{kind}: {text}", width)
    # escapes names and messages, so that each stays on one line
    return list(map(ascii_text, lines))


def where_to_see_more(page: str) -> tuple[str, str]:
    """Return a path or command that shows the remaining findings, and the words to print after it."""
    return (
        (page, " among the files of this job")
        if page
        else (command("pytest_pafot", "corpus", "list"), "")
    )


def annotation_lines(sightings: Iterable[Seen], page: str = "") -> list[str]:
    """Return GitHub Actions commands that annotate the worst five failures in their test files.

    ``page`` is the path of the report page, or empty.
    """
    worst = ranked(sightings)
    lines = []
    for sighting in worst[:MAX_ANNOTATED]:
        text = "%0A".join(
            ascii_text(each).replace("%", "%25") for each in describe_failure(sighting)
        )
        file, title = (
            ascii_text(each).replace("%", "%25").replace(":", "%3A").replace(",", "%2C")
            for each in (sighting.node_id.partition("::")[0], sighting.id)
        )
        lines.append(f"::error file={file},title={title}::{text}")
    left = len(worst) - MAX_ANNOTATED
    where, rest = where_to_see_more(page)
    where = where if page else f"`{where}`"
    text = ascii_text(f"{plural(left, 'more finding')}: see {where}{rest}").replace("%", "%25")
    return [*lines, f"::notice title=pafot::{text}"] if left > 0 else lines


def _listed(names: Sequence[str], limit: int = MAX_FINDS) -> str:
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return f"{', '.join(names[:limit])}{more}"


def _wrapped(text: str, width: int) -> list[str]:
    return wrapped_to(f"  {ascii_text(text.strip())}", width)
