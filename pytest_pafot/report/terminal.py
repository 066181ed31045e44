"""The plugin's output in the terminal: progress, findings, failures of searches, and the session's summary.

Lines are ASCII and fit the width of the terminal, except for node ids, paths and the user's own words.
"""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from pytest_pafot.attribution.sentences import AT_FAULT
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.shrink import described
from pytest_pafot.findings.sighting import NOT_REPEATED, Beyond, Seen
from pytest_pafot.findings.verdict import worsening
from pytest_pafot.model.trace import SURVIVES, WORLD_HANG, Outcome
from pytest_pafot.report.messages import Event
from pytest_pafot.report.session import UNNAMED_ADVICE, Session
from pytest_pafot.searches.events import (
    UNTESTED,
    Ending,
    Note,
    Progress,
    Search,
    by_test,
    concluded,
)
from pytest_pafot.support.errors import OF_SEARCH, command, flag, rerun
from pytest_pafot.support.proportions import interval_text
from pytest_pafot.support.text import (
    ascii_text,
    capitalised,
    first_of,
    fitted_lines,
    listed,
    plural,
    wrapped_to,
)

WIDTH = 80
MINUTE, HOUR = 60, 3600
# If more time than this [s] is left, the progress line names the option that limits it.
LONG = 600
# The maximum number of lines in the block on a failure, at 80 columns and without the title.
ROOM = 11
# The maximum lengths of lists: a search's kinds of failures, its new findings, findings that annotate a CI job, saved
# scenarios that were not replayed, and replays that need attention.
MAX_KINDS = 3
MAX_FINDS = 20
MAX_ANNOTATED = 5
MAX_LEFT = 5
MAX_REPLAYS = 10
# Why a search ended early, as the end of a sentence after "because". Unknown reasons are missing.
WHY = {
    Ending.FINDINGS: "it had enough findings",
    Ending.REPLAYS: "it only replayed",
    Ending.ERROR: "of an error",
    Ending.INTERRUPTED: "it was interrupted",
    Ending.MAX_TIME: f"of {Ending.MAX_TIME}",
}

BEST_ACTION = (
    "or make a model take its best action (in Stable-Baselines3: predict(..., deterministic=True))"
)
DRAWS = f"the policy probably has its own random generator. Seed it in the factory of the policy, {BEST_ACTION}"
DRAWS_IN_WRAPPERS = (
    "the policy or a wrapper probably has its own random generator. In a wrapper, draw from self.np_random. Seed the "
    f"generator of a policy in its factory, {BEST_ACTION}"
)


def add_event(session: Session, event: Event, item: str = "", view: str = "") -> None:
    """Add an event from an item to the record. ``view`` is a finding's data for the page, as JSON."""
    match event:
        case Search():
            finds = tuple(_with_alike(session, find) for find in event.finds)
            # Removed first, because searches are listed in the order in which they ended.
            session.searches.pop(event.node_id, None)
            session.searches[event.node_id] = replace(event, finds=finds)
        case Seen():
            earlier = session.seen.pop(event.node_id, None)
            # If the session also replays the new file of a search, the replay must not hide that it is unshrunk.
            if earlier is not None and earlier.unshrunk and not event.is_new:
                event = replace(event, unshrunk=earlier.unshrunk)
            session.seen[event.node_id] = event
            session.items[event.node_id] = item
            if event.is_new:
                session.new_files.add(event.path)
            if view:
                session.views[event.node_id] = zlib.compress(view.encode(), level=1)
        case Note(kind="incomparable"):
            session.incomparable[event.text] = None
        case Note():
            texts = session.warnings if event.kind == "warning" else session.notes
            # Many items can send the same note, for example about an option.
            if event.text not in texts:
                texts.append(event.text)


def _with_alike(session: Session, find: Seen) -> Seen:
    # A search counts the runs that failed like its finding, so the number is known only at its end.
    known = session.seen.get(find.node_id)
    if known is None or not known.is_new:
        return find
    session.seen[find.node_id] = replace(known, alike=find.alike)
    return session.seen[find.node_id]


def add_failure(
    session: Session,
    node_id: str,
    phase: str,
    text: str,
    reason: str,
    saved: Mapping[str, str] | None,
) -> None:
    """Add an item's failure to the record, even if its search or replay could not start.

    ``saved`` has the id, file and test of a replayed scenario. It is None for a search.
    """
    session.failures[node_id, phase] = text
    session.reasons.setdefault(node_id, reason)
    if node_id in session.seen:  # The finding describes the failure.
        return
    if saved is None:
        session.searches.setdefault(node_id, Search(node_id=node_id))
    else:
        words = ["python", "-m", "pytest", *session.options, saved["file"]]
        again = rerun(words, os.environ, saved=saved["id"])
        session.unread.setdefault(node_id, {**saved, "replay": again})


def findings_of(session: Session) -> dict[str, Seen]:
    """Return the findings by node id. A replay includes the result of its test's search."""
    searches = by_test(session.ended)
    return {node_id: concluded(each, searches) for node_id, each in session.seen.items()}


def replays_of(session: Session) -> list[Seen]:
    """Return the replays, in the order in which they ended."""
    return [each for each in findings_of(session).values() if not each.is_new]


def failures_of(session: Session) -> list[Seen]:
    """Return the failures that make a session fail."""
    known = [each for each in replays_of(session) if each.headline and each.label != "accepted"]
    return [*session.finds, *known]


def command_for(session: Session, seen: Seen, *words: str, name: str = "") -> str:
    """Return the command that runs a finding again, or its search if the finding was not saved."""
    if seen.path:
        again = [*words, *session.options, name or seen.path]
        return rerun(again, os.environ, saved=seen.id)
    # There is no file, so only the search can show it again.
    item = session.items.get(seen.node_id, "")
    search = session.searches.get(item, Search(node_id=item))
    return rerun([*words, item], os.environ, *search.options.split())


def progress_line(progress: Progress, width: int = WIDTH) -> str:
    """Return a progress line. If it is too long, shorten the node id first and then the end."""
    tail = f" {progress.phase or _counts_so_far(progress)}"
    # The end of a node id distinguishes the tests of a file, so some of it is always shown.
    room = max(12, width - len(tail) - 8)
    name = ascii_text(progress.node_id)
    if len(name) > room:
        name = f"...{name[3 - room :]}"
    return f"pafot: {name}{tail}"[:width]


def _counts_so_far(progress: Progress) -> str:
    counts = []
    if progress.generations is not None:
        counts.append(f"{progress.generation}/{progress.generations} generations")
    if progress.budget is None:
        counts.append(plural(progress.runs, "run"))
    else:
        counts.append(f"{progress.runs}/{progress.budget} runs")
    counts += [f"{progress.failing} failed", f"{progress.finds} new"]
    speed = 0.0
    if progress.seconds > 0:
        speed = progress.runs / progress.seconds
    if 0 < speed < 1:
        counts.append(f"{1 / speed:.0f} s per run")
    else:
        counts.append(f"{plural(round(speed), 'run')}/s")
    # If more than a minute is left, show how long. If much more is left, also show how to limit it.
    if progress.left >= MINUTE:
        left = f"about {progress.left / MINUTE:.0f} min left"
        if progress.left >= 2 * HOUR:
            left = f"about {progress.left / HOUR:.1f} h left"
        if progress.decision_seconds:
            left += f" at {1000 * progress.decision_seconds:.3g} ms per decision"
        if progress.left >= LONG and not progress.is_limited:
            left += f"; limit it with {flag('max_time', LONG)}"
        counts.append(left)
    return ", ".join(counts)


def found_line(seen: Seen) -> str:
    """Return the line that announces a new finding while the search continues."""
    expect = seen.finding.expect
    kinds = {
        "collision": "a collision",
        "ads_error": "an error in the policy",
        "hang": "a hang in the policy",
    }
    what = kinds.get(expect.outcome, "a failure")
    if expect.is_crash:
        # A process that died in a hang is reported as a hang.
        if expect.outcome is not Outcome.HANG or expect.signature.is_property:
            what = "a process crash"
    elif expect.signature.is_property:
        what = "a failed check" if expect.check else "a failed assertion"
    line = f"pafot: found {what}: {seen.node_id}"
    if not seen.path:
        line += f", not saved: {seen.detail}"
    return ascii_text(line)


def describe_failure(seen: Seen) -> list[str]:
    """Describe what happened, in the same words for all reports: headline, sentences and decision."""
    expect, sentences = seen.finding.expect, seen.sentences
    first = seen.headline
    if sentences:
        for fault in AT_FAULT.values():  # The sentences state it.
            first = first.replace(f"; {fault}", "")
    if not first.endswith((".", "?")):
        first += "."
    frame: list[str] = []
    if seen.is_as_saved and expect.check:
        first = f"The check fails: {first}"
    elif seen.is_as_saved and expect.outcome in ("ads_error", "hang"):
        who = "environment" if first.startswith(WORLD_HANG) else "policy"
        first = f"The {who} failed after {expect.time:.1f} s: {first}"
        # The last frame in the policy: its two lines, without the markers below them.
        traceback = map(str.rstrip, expect.traceback.splitlines())
        lines = [line for line in traceback if line.startswith("  ") and line.strip(" ~^")]
        frame = lines[-2:]
    told = [first, *frame, *sentences]
    if seen.moment is not None:
        told.append(seen.moment.brief)
    return told


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
    finding, moment, accepted = seen.finding, seen.moment, seen.replay.acceptance
    expect = finding.expect
    first, *others = describe_failure(seen)
    # A replay can fail in a different way than its file.
    if expect.is_crash and text and seen.is_as_saved:
        end = " ".join(text.removeprefix("Failed: ").split())
        first = f"{capitalised(end).removesuffix('.')}."
        place = ""
    # The sentences explain any other failure better than the line of its assertion.
    has_place = expect.signature.is_property or expect.is_crash
    if expect.check is not None or not has_place:
        place = ""
    # Each text has a number. Texts with 0 must stay. Texts with the largest numbers are omitted first: a condition of
    # several lines, the number of similar runs, which the summary repeats, the ego's actions, and then the policy's
    # condition and decision.
    parts: list[tuple[int, str]] = []
    message = next(iter(text.splitlines()), "").removeprefix("AssertionError: ")
    if place and message not in first and not seen.is_flaky:
        condition = f" ({expect.assertion})" if expect.assertion else ""
        parts.append((0, f"{place}: {message}{condition}."))
    elif place:
        first = f"{place}: {first}"
    parts.append((0, first))
    ranks = dict(zip(reversed(seen.sentences[-2:]), (0, 9), strict=False))
    if moment is not None:
        ranks[moment.brief] = 7
    parts += [(ranks.get(text, 5), text) for text in others]
    if moment is not None and is_whole:
        parts[-1] = 0, str(moment)
        parts += [(0, f"  {line}") for line in moment.condition_lines()]
    elif moment is not None:
        # Without a difference, only a condition on this NPC is relevant. Others may be about an empty row, for example.
        is_any = moment.otherwise or moment.reference
        groups = [rows for whom, rows in moment.conditions if is_any or whom == f"NPC {moment.npc}"]
        row = next((f"  {row}" for rows in groups for row in rows), "")
        if len(row) > WIDTH:
            parts.append((11, row))
        elif row:
            parts.append((8, row))
    parts += [(4, f"{capitalised(text)}.") for text in _remarks_on(seen)]
    if is_whole:
        parts += [(0, f"It was simplified {how}.") for how in shrunk_lines(finding)]
    if search is not None and seen.is_new and search.runs > 1:
        like = "No other run"
        worst = seen.worst and f". The original run {seen.alike.severity}"
        if seen.alike.runs:
            like = f"{1 + seen.alike.runs} of {search.runs} runs"
            worst = seen.worst and f". {capitalised(seen.worst)}"
        parts.append((10, f"{like} failed in the same way{worst}."))
    if expect.against:
        parts.append((1, f"The reference {expect.against} passes this scenario."))
    if not seen.is_new:
        detail = seen.detail and f" ({seen.detail})"
        parts.append((1, f"Result of the replay: {seen.label}{detail}."))
    elif seen.detail:
        what = "The saved file" if seen.path else "It was not saved:"
        parts.append((0, f"{what} {seen.detail}."))
    if isinstance(accepted, Beyond):
        accepts = f"The line `xfail:` in {seen.path} accepts `{expect.brief}`, but this failure differs: {accepted.why}"
        way_out = "Correct the policy, or delete the file, search again and accept the new finding"
        parts.append((0, f"The failure is not accepted. {accepts}. {way_out}."))
    room = ROOM - bool(again)  # The command has a line of its own.
    while not is_whole:
        height = sum(len(wrapped_to(ascii_text(text), WIDTH)) for _, text in parts)
        spared = max(parts, key=lambda part: part[0])
        if height <= room or spared[0] == 0:
            break
        parts.remove(spared)
    lines = fitted_lines([ascii_text(text) for _, text in parts], width)
    # Without a file, the scenario would be lost. With --pafot-save=none, the user does not want it.
    if not seen.path and seen.detail != flag("save", "none"):
        lines.append("The file would contain:")
        lines += [ascii_text(f"  {line}") for line in text_of(finding).splitlines()]
    if again:  # It is not wrapped, so that it can be copied.
        lines.append(ascii_text(f"replay {again}"))
    return lines


def _remarks_on(seen: Seen) -> list[str]:
    remarks = []
    if seen.remark:
        remarks.append(". ".join(map(capitalised, seen.remark.split("; "))))
    flaky, has_wrappers = seen.finding.flaky or "", seen.finding.world.get("wrappers")
    # State that survives in the world is not a random generator of the policy.
    if flaky.startswith(NOT_REPEATED) and (has_wrappers or SURVIVES not in flaky):
        remarks.append(DRAWS_IN_WRAPPERS if has_wrappers else DRAWS)
    elif seen.is_flaky:
        remarks.append("it was not simplified, because its runs differ")
    return remarks


def shrunk_lines(finding: Finding) -> list[str]:
    """Return a line about how a finding was simplified, if it was."""
    if finding.shrunk is None or not finding.shrunk.before:
        return []
    before = finding.shrunk.before.split(", ")
    after = described(finding.scenario, finding.longest_run).split(", ")
    pairs = zip(before, after, strict=True)
    changed = [(old, new) for old, new in pairs if old != new]
    how = "to a simpler scenario of the same size"
    if changed:
        old, new = map(", ".join, zip(*changed, strict=True))
        how = f"from {old} to {new}"
    if not finding.shrunk.is_minimal:
        how += "; a simpler scenario may exist"
    return [how]


def ranked(findings: Iterable[Seen]) -> list[Seen]:
    """Return findings with the worst first."""
    return sorted(findings, key=lambda each: each.rank)


def failure_message(search: Search) -> str:
    """Return the reason why a search's item fails."""
    names = [f"{each.id} (flaky)" if each.is_flaky else each.id for each in ranked(search.finds)]
    return f"{plural(len(names), 'new failure')} in {plural(search.runs, 'run')}: {first_of(names, MAX_FINDS)}"


def random_failures(search: Search) -> int:
    """Return the number of random scenarios that failed, whoever was at fault."""
    return search.random["at_fault"] + search.random["otherwise"]


def search_lines(search: Search, *, width: int = WIDTH, is_whole: bool = False) -> list[str]:
    """Summarise a search in at most eight lines at 80 columns. Warnings and ``is_whole`` add lines."""
    finds, kinds = ranked(search.finds), search.kinds
    drawn, failing = search.random["runs"], random_failures(search)
    evaluated = search.runs - sum(kinds[kind] for kind in UNTESTED)
    first = f"{kinds['failed'] or 'none'} of {plural(search.runs, 'run')} failed"
    share = ""
    # Omit the proportion if the reference failed in some runs, because these count as failures of random scenarios.
    if drawn and not kinds["common"]:
        share = f"of {plural(drawn, 'random scenario')} failed: {interval_text(failing, drawn)}"
    # All scenarios were drawn at random.
    if share and (drawn, failing) == (evaluated, kinds["failed"]):
        first = f"{failing or 'none'} {share}"
        share = ""
    if kinds["npc"]:
        first += f"; in {plural(kinds['npc'], 'other')}, an NPC was responsible"
    if kinds["common"]:
        first += f"; in {plural(kinds['common'], 'other')}, the reference also failed"
    rows = []
    for each in finds:
        what = "new, flaky" if each.is_flaky else "new"
        rows.append(f"{each.id}: {plural(1 + each.alike.runs, 'run')}{each.impacts} ({what})")
    for id_, count in sorted(search.known.items()):
        rows.append(f"{id_}: {plural(count, 'run')} (known)")
    if len(rows) > MAX_KINDS and not is_whole:
        # The last row states how many kinds are omitted.
        left = len(rows) - MAX_KINDS + 1
        rows[MAX_KINDS - 1 :] = [f"{left} more kinds of failures"]
    texts = [first, *rows]
    if share:
        texts.append(f"{failing or 'None'} {share}")
    # A session may have hundreds of searches without a failure, so each of them takes only one line.
    has_passed = evaluated and search.reason.is_complete and not search.failing
    if is_whole or finds or not has_passed:
        texts.append(f"{listed(_efforts(search))} took {search.seconds:.1f} s")
    if not search.reason.is_complete:
        made = {"generations": search.generations, "runs": search.runs}
        left_out = [
            f"{made[what]} of {most} {what}"
            for what, most in search.asked.items()
            if made[what] < most
        ]
        early = "The search ended early"
        if left_out:
            early += f", after {listed(left_out)}"
        if search.reason:
            early += f", because {WHY[search.reason]}"
        texts.append(early)
    folders = [os.path.dirname(each.path) for each in finds if each.path]  # noqa: PTH120
    if folders:
        texts.append(f"Saved in {' and '.join(dict.fromkeys(folders))}")
        # The command `search` prints its own advice.
        if not os.environ.get(OF_SEARCH):
            texts[-1] += ". Commit the files"
    unsaved = dict.fromkeys(each.detail for each in finds if not each.path)
    texts += [f"Not saved: {each}" for each in unsaved]
    if search.compared:
        texts.append(capitalised(search.compared))
    if search.no_worse:
        names = [
            f"{id_} ({headline})" if headline else id_ for id_, headline in search.no_worse.items()
        ]
        why = "the reference fails as often in other scenarios"
        texts.append(f"Not counted, because {why}: {first_of(names, MAX_FINDS)}")
    if is_whole and search.no_interaction:
        texts.append(f"{search.no_interaction} of these runs had no interaction")
    if is_whole and search.reached is not None:
        texts.append(f"NPCs reached {100 * search.reached:.0f} % of their goals")
    if is_whole and search.drawn:
        texts.append(capitalised(search.drawn))
    if is_whole:
        seed = f"seed {search.seed} from {flag('seed', search.base_seed)}"
        texts.append(f"Algorithm: {search.algorithm}, with {seed}")
    lines = wrapped_to(ascii_text(f"{search.node_id}: {texts[0]}."), width)
    for text in texts[1:]:
        lines += _wrapped(f"{text}.", width)
    for text in search.warnings:
        lines += _wrapped(f"warning: {text}", width)
    for text in (*search.process_notes, *search.notes):
        lines += _wrapped(f"note: {text}", width)
    return lines


def _efforts(search: Search) -> list[str]:
    more = search.more_runs
    untested = [f"{search.kinds[kind]} {kind}" for kind in UNTESTED if search.kinds[kind]]
    efforts = [plural(search.runs, "run")]
    if untested:
        efforts[0] += f" ({listed(untested)})"
    if more["known"]:
        efforts.append(f"{plural(more['known'], 'scenario')} with a known result")
    if more["shrink"] or more["moment"]:
        efforts.append(f"{more['shrink'] + more['moment']} more to analyse failures")
    if search.decisions.total():
        efforts.append(f"{search.decisions.total():,} decisions")
    return efforts


def replay_counts(replays: Sequence[Seen]) -> str:
    """Return the number of replays, and the number for each result."""
    counts = sorted(Counter(replay.result for replay in replays).items())
    figures = ", ".join(f"{count} {result}" for result, count in counts)
    return f"{plural(len(replays), 'saved scenario')}: {figures}"


def replay_lines(replays: Sequence[Seen], width: int = WIDTH) -> list[str]:
    """Return lines with the number of replays for each result, and then the replays that need attention."""
    if not replays:
        return []
    lines = wrapped_to(f"replayed {replay_counts(replays)}", width)
    shown = [
        each for each in replays if each.result != "still failing" or each.compared == "introduced"
    ]
    for replay in shown[:MAX_REPLAYS]:
        lines.append(f"  {replay.result}: {replay.node_id}")
        remarks = "; ".join(filter(None, [replay.on_search, replay.detail]))
        if remarks:
            lines += [f"  {line}" for line in _wrapped(remarks, width - 2)]
    if len(shown) > MAX_REPLAYS:
        lines.append(f"  ... and {len(shown) - MAX_REPLAYS} more")
    return lines


def against_lines(session: Session, width: int = WIDTH) -> list[str]:
    """Count the failures that the policy introduces, that it fixes and that both have, for each reference."""
    lines: list[str] = []
    if session.incomparable:  # otherwise, the counts would be incomplete
        return lines
    replays = replays_of(session)
    names = [each.against for each in session.ended]
    names += [each.replay.against for each in replays]
    for name in filter(None, dict.fromkeys(names)):
        own = [each for each in replays if each.replay.against == name]
        searches = [each for each in session.ended if each.against == name]
        counts = Counter(replay.compared for replay in own)
        found = sum(len(each.finds) for each in searches)
        introduced = plural(found + counts["introduced"], "failure")
        text = f"compared with {name}: {introduced} introduced, {counts['fixed']} fixed, {counts['common']} unchanged"
        elsewhere = sum(len(each.no_worse) for each in searches)
        if elsewhere:
            text += f", {elsewhere} in other scenarios"
        lines += wrapped_to(text, width)
        common = [each for each in own if each.compared == "common"]
        changes = [(each.id, worsening(each.severity, each.replay.before)) for each in common]
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
    for node_id in session.running:  # They were interrupted, or their worker died.
        lines.append(node_id)
        lines += _wrapped("did not finish; its findings so far are reported", width)
    lines += replay_lines(replays_of(session), width)
    lines += against_lines(session, width)
    for test in session.unnamed:
        lines.append(f"not run: {test}: pytest does not collect it. {UNNAMED_ADVICE}")
    if session.left:
        count = plural(len(session.left), "saved scenario")
        lines.append(f"not run: {count}: {first_of(session.left, MAX_LEFT)}")
    # The command `search` prints its own advice.
    if any(find.path for find in session.finds) and not os.environ.get(OF_SEARCH):
        seeds = [each.base_seed for each in session.ended if each.finds]
        again = " or ".join(f"pytest {flag('seed', seed)}" for seed in dict.fromkeys(seeds))
        what = "this search" if len(session.ended) == 1 else "the searches"
        replay = " ".join(["pytest", *session.options, flag("runs", 0)])
        advice = f"{replay} replays the saved scenarios, and {again} repeats {what}."
        lines += wrapped_to(advice, width)
    for text in session.written:
        lines += text.splitlines()
    remarks = [f"warning: {text}" for text in sorted(set(session.warnings))]
    remarks += [f"note: {text}" for text in session.notes]
    remarks += [f"problem: {text}" for text in session.problems]
    for remark in remarks:
        lines += _wrapped(remark, width)
    # escapes names and messages, so that each stays on one line
    return list(map(ascii_text, lines))


def where_to_see_more(page: str) -> tuple[str, str]:
    """Return a path or command that shows the remaining findings, and the words to print after it."""
    if page:
        return page, " among the files of this job"
    return command("pytest_pafot", "corpus", "list"), ""


def annotation_lines(sightings: Iterable[Seen], page: str = "") -> list[str]:
    """Return GitHub Actions commands that annotate the worst five failures in their test files.

    ``page`` is the path of the report page, or empty.
    """
    worst = ranked(sightings)
    lines = []
    for sighting in worst[:MAX_ANNOTATED]:
        # A line break would end the command. GitHub decodes this one.
        text = "%0A".join(map(_escaped, describe_failure(sighting)))
        file = _escaped_property(sighting.node_id.partition("::")[0])
        lines.append(f"::error file={file},title={_escaped_property(sighting.id)}::{text}")
    left = len(worst) - MAX_ANNOTATED
    if left > 0:
        where, rest = where_to_see_more(page)
        if not page:
            where = f"`{where}`"
        text = _escaped(f"{plural(left, 'more finding')}: see {where}{rest}")
        lines.append(f"::notice title=pafot::{text}")
    return lines


def _escaped(text: str) -> str:
    return ascii_text(text).replace("%", "%25")


def _escaped_property(text: str) -> str:
    return _escaped(text).replace(":", "%3A").replace(",", "%2C")


def _wrapped(text: str, width: int) -> list[str]:
    return wrapped_to(f"  {ascii_text(text.strip())}", width)
