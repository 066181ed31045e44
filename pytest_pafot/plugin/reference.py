"""Reference documentation of the options, made from their table."""

from __future__ import annotations

from pytest_pafot.campaign.options import OPTIONS, PROFILES, Option

HEADER = ("Command line", "ini / toml key", "Variable", "Marker argument", "Default", "Meaning")


def options_table() -> str:
    """A Markdown table with a row for every option."""
    rows = [HEADER, ("---",) * len(HEADER), *map(_row, OPTIONS)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def _row(option: Option) -> tuple[str, ...]:
    flag = option.flag if option.kind == "switch" else f"{option.flag}={option.metavar}"
    argument = f"{option.name}=" if option.is_argument else ""
    elsewhere = (option.key, option.variable, argument) if option.everywhere else ("", "", "")
    choices = f" One of {', '.join(f'`{choice}`' for choice in option.choices)}." if option.choices else ""
    return (*(f"`{name}`" if name else "-" for name in (flag, *elsewhere)), _default(option), f"{option.help}{choices}")


def _default(option: Option) -> str:
    profiles = [f"`{values[option.name]}` ({name})" for name, values in PROFILES.items() if option.name in values]
    plain = "none" if option.default is None else f"`{option.default}`"
    if option.name == "seed":
        plain = "fresh"
    return ", ".join(profiles) if len(profiles) == len(PROFILES) else ", ".join([plain, *profiles])
