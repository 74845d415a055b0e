"""What SIGTERM, SIGINT and SIGUSR1 do: a training saves its state and ends; anything else ends at once.

The exit status is 128 plus the number of the signal.

A signal that was ignored when the process began stays ignored. `nohup` and shells start background jobs in this way, so
that a Ctrl-C that is meant for another program does not end them.

Python runs a signal's handler in the main thread, between two bytecodes. But the main thread may compile inside XLA for
minutes. Therefore another thread waits for signals: Python's C handler writes the number of each signal into a pipe.
"""

import os
import signal
import sys
import threading
from types import TracebackType
from typing import NoReturn, Self

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)  # batch systems announce the end of a job by one of them
_SHOW_CURSOR = "\x1b[?25h"


class Interruption:
    """Handles the signals. Use it as a context manager in the main thread; in any other thread it does nothing.

    After `defer`, a first signal only makes `requested` true. A second one ends the process at once.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._deferred = False
        self._requested: signal.Signals | None = None

    def __enter__(self) -> Self:
        self._main = threading.current_thread() is threading.main_thread()
        if self._main:
            self._ears, mouth = os.pipe()
            os.set_blocking(mouth, False)
            self._mouth = mouth
            self._handlers = {number: signal.signal(number, lambda *_: None) for number in SIGNALS if _is_heard(number)}
            self._descriptor = signal.set_wakeup_fd(mouth, warn_on_full_buffer=False)
            self._thread = threading.Thread(target=self._listen, daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._main:
            signal.set_wakeup_fd(self._descriptor)
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            os.write(self._mouth, b"\0")
            self._thread.join()
            os.close(self._mouth)
            os.close(self._ears)

    def defer(self) -> None:
        """From now on there is something to save: a signal makes `requested` true and does not end the process."""
        with self._lock:
            self._deferred = True

    def requested(self) -> bool:
        """Whether a signal has come."""
        return self._requested is not None

    def settle(self, state: str) -> None:
        """Everything is saved: ends the process if a signal has come, with `state` as the message.

        From now on a signal ends the process at once.
        """
        with self._lock:
            self._deferred = False
            if self._requested is not None:
                print(_farewell(self._requested, state), file=sys.stderr)
                raise SystemExit(128 + self._requested)

    def _listen(self) -> None:
        while number := os.read(self._ears, 1)[0]:
            if number not in SIGNALS:
                continue
            with self._lock:
                if not self._deferred or self._requested is not None:
                    _leave(signal.Signals(number))
                self._requested = signal.Signals(number)


def _is_heard(number: signal.Signals) -> bool:
    """Whether to handle the signal: it is not ignored, and its handler (None if it is C code) can be restored."""
    return signal.getsignal(number) not in (signal.SIG_IGN, None)


def _farewell(number: signal.Signals, state: str) -> str:
    return f"{number.name}: {state}"


def _leave(number: signal.Signals) -> NoReturn:
    """Ends the process from any thread, even while the main thread is inside C code."""
    cursor = _SHOW_CURSOR if os.isatty(2) else ""
    text = _farewell(number, "stopped; nothing that was saved is lost, and --resume continues from there")
    os.write(2, f"{cursor}\n{text}\n".encode())
    os._exit(128 + number)


def stop_at_eof() -> None:
    """Sends this process SIGTERM as soon as its standard input ends.

    A parent process that waits for this one holds the input open; its end closes the input, however it ends. The parent
    also uses SIGTERM to stop this process. So SIGTERM is no longer ignored, even if the parent was started that way.
    """
    if not _is_heard(signal.SIGTERM):
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 1):  # not by sys.stdin.read, which holds a lock that Python needs to exit
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()
