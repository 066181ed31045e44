"""The header of a verbose session says how the kernel runs."""

from __future__ import annotations

from pytest_pafot.world import kernel


def test_a_session_that_is_not_verbose_says_nothing(project):
    project.run().stdout.no_fnmatch_line("*kernel*")


def test_a_verbose_session_says_it_once(project):
    result = project.run("-v")
    told = [line for line in result.outlines if line.startswith("pafot: kernel")]
    expected = "compiled" if kernel.is_compiled() else "interpreted"
    assert len(told) == 1
    assert told[0].startswith(f"pafot: kernel {expected}")


def test_header_names_kernel_forced_by_the_environment(project, monkeypatch):
    monkeypatch.setenv("PAFOT_KERNEL", "interpreted")
    project.run("-v").stdout.fnmatch_lines(["pafot: kernel interpreted (*"])
