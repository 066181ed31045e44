"""Sessions of pytest inside of a test, deep in the calls of the session that runs it."""


def in_process(pytester, *args, **kwargs):
    """``pytester.runpytest_inprocess``, in a frame that brings room for all frames of the calls in it.

    CPython keeps frames in pieces of 16 KiB, and asks the system for a new piece at each call that does not fit, which
    goes back when the call returns: where a loop calls so deep, that takes more time than what it calls. A frame that
    needs more has a piece of its own, of twice the size or a little less, and later frames use the rest of it.
    """
    return pytester.runpytest_inprocess(*args, **kwargs)


in_process.__code__ = in_process.__code__.replace(co_stacksize=70_000)
