"""The header of a verbose session says how the kernel runs."""

from __future__ import annotations

from pytest_pafot.world import kernel


def test_only_a_verbose_session_says_once_how_the_kernel_runs(project, monkeypatch):
    assert not any("pafot: kernel" in line for line in project.run().outlines)
    (told,) = [line for line in project.run("-v").outlines if "pafot: kernel" in line]
    assert told.startswith(f"pafot: kernel {'compiled' if kernel.is_compiled() else 'interpreted'}")
    monkeypatch.setenv("PAFOT_KERNEL", "interpreted")
    project.run("-v").stdout.fnmatch_lines(["pafot: kernel interpreted (*"])
