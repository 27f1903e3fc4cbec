"""What all tests rely on."""

import signal


def pytest_configure() -> None:
    # Whoever starts the tests in the background starts them with Ctrl-C ignored, and so their child processes.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
