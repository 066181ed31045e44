"""Measure work by counting calls: a clock would also measure other work of the machine."""

import sys


def calls_in(function, *arguments):
    """Return the number of function calls within a call, including C functions; ignore what it raises."""
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
