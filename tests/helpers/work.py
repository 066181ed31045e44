"""How much work a call is, counted: a clock would also count what else the machine does."""

import sys


def calls_in(function, *arguments):
    """How many functions are called in a call, those of C among them; what it raises is not counted."""
    count = 0

    def note(frame, event, argument):
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        function(*arguments)
    finally:
        sys.setprofile(before)
    return count
