"""What a process does before it begins, so that it hears an interrupt whoever started the tests."""

import signal


def hears_signals():
    """A shell lets what it starts in the background ignore interrupts, and so does all that this starts."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
