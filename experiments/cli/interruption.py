"""SIGTERM, SIGINT and SIGUSR1: a training saves and leaves, anything else leaves at once; status 128 + signal.

A signal that was ignored when the process began stays ignored: `nohup` and shells that start background jobs do this so
that a Ctrl-C meant for another program does not end the job.

Python runs its handlers between two bytecodes of the main thread, which compiles for minutes inside XLA. So a thread
of its own hears of a signal, through the pipe that Python's C handler writes to.
"""

import os
import signal
import sys
import threading
from types import TracebackType
from typing import NoReturn, Self

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)  # batch systems announce the end by one of these
_SHOW_CURSOR = "\x1b[?25h"


class Interruption:
    """Use it as a context manager in the main thread. While `defer` holds, a first signal is kept for the caller."""

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
        """From now on there is something to save: a signal is kept until `requested` is asked."""
        with self._lock:
            self._deferred = True

    def requested(self) -> bool:
        """Whether a signal came."""
        return self._requested is not None

    def settle(self, state: str) -> None:
        """What there was to save is saved: leaves if a signal came, and at once when the next comes."""
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
    """Whether a signal has an effect; None stands for a handler of C code, which Python could not put back."""
    return signal.getsignal(number) not in (signal.SIG_IGN, None)


def _farewell(number: signal.Signals, state: str) -> str:
    return f"{number.name}: {state}"


def _leave(number: signal.Signals) -> NoReturn:
    """Ends the process from any thread, whatever the main thread does."""
    cursor = _SHOW_CURSOR if os.isatty(2) else ""
    text = _farewell(number, "stopped; nothing that was saved is lost, and --resume continues from there")
    os.write(2, f"{cursor}\n{text}\n".encode())
    os._exit(128 + number)


def stop_at_eof() -> None:
    """SIGTERM for this process as soon as its standard input ends: whoever waits for it, holding that open, is gone.

    SIGTERM is also how whoever waits stops this process. So it is heard even where it was ignored when that one began.
    """
    if not _is_heard(signal.SIGTERM):
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 1):  # not through its buffer, whose lock Python wants when it ends
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()
