"""The run's side of a live view: it tells a process of its own what there is to see, and never waits for it.

That process may be slow, hang or die: it misses what it does not take in time, and the run goes on.
"""

from __future__ import annotations

import importlib.util
import logging
import multiprocessing
import queue
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING

from dualslam.core.errors import InputError, OutputError, how_to_install
from dualslam.core.resources import start_undisturbed
from dualslam.core.types import Frame
from dualslam.core.walk_news import WalkNews
from dualslam.map.frame_records import FrameResult
from dualslam.viewer.messages import Message, Teller

if TYPE_CHECKING:
    from dualslam.system.system import System

log = logging.getLogger(__name__)

EVERY_S = 0.2
"""Between two messages: a camera that moves five times a second is seen to move."""
START_S = 30.0
"""How long the process may take to begin: it imports its libraries, on a machine that may be busy."""
END_S = 5.0
"""How long it may take to show the last message."""
PAUSE, SAVE = "pause", "save"


class LiveView:
    """A run in the browser, at an address of this machine alone.

    `port`: of 127.0.0.1; 0 takes a free one.

    - `on_save`: called between two frames with a page of the map as it stands (HTML), where a person asks for it.

    Raises `InputError` if the viewer is not installed.
    Raises `OutputError` if it cannot start, or the port is taken.
    """

    def __init__(self, port: int = 0) -> None:
        if importlib.util.find_spec("viser") is None:
            raise InputError(f"--live needs the live viewer: {how_to_install('live')}.")
        self.on_save: Callable[[str], None] | None = None
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, port), daemon=True, name="dualslam live view")
        start_undisturbed(self._process)
        theirs.close()
        self.url = self._await_start()
        self._teller: Teller | None = None
        self._outbox: queue.Queue[Message | str] = queue.Queue(maxsize=1)
        self._idle, self._over = threading.Event(), threading.Event()
        self._idle.set()
        self._pages: queue.Queue[str] = queue.Queue()
        self._paused = False
        self._told_s = -EVERY_S
        self._last: tuple[Frame, FrameResult] | None = None
        self._thread = threading.Thread(target=self._converse, daemon=True, name="live view")
        self._thread.start()

    def _await_start(self) -> str:
        answer = None
        try:
            if self._pipe.poll(START_S):
                answer = self._pipe.recv()
        except (EOFError, OSError):
            pass
        if not isinstance(answer, tuple) or answer[0] != "at":
            self._process.kill()
            raise OutputError(str(answer[1]) if isinstance(answer, tuple) else "the live view did not start.")
        return str(answer[1])

    @property
    def alive(self) -> bool:
        """Whether anyone listens."""
        return not self._over.is_set()

    # --- the run's thread

    def begin(self, system: System) -> None:
        """Watch a system."""
        self._teller = Teller(system)
        system.watch_walks(self._on_walk)

    def after(self, frame: Frame, result: FrameResult) -> None:
        """Tell of a frame, where there is time."""
        self._last = frame, result
        self._tell_if_due()
        self._save()

    def _on_walk(self, news: WalkNews) -> None:
        """Tell of reverse tracking, for which the run itself waits where there are no workers."""
        assert self._teller is not None
        self._teller.note_walk(news)
        if self._last is not None:
            self._tell_if_due(within_step=True)

    def is_paused(self) -> bool:
        """Whether a person wants the run to wait; asked for as long as it does. Nobody does once the viewer is gone."""
        if self._paused and self._last is not None:
            self._tell_if_due()
            self._save()
        return self._paused and self.alive

    def end(self) -> None:
        """Show how the run ended; the page stays as long as this process does, or until `close`."""
        if self._last is None or self._teller is None or not self._idle.wait(END_S) or not self.alive:
            return
        self._tell(over=True)
        self._idle.wait(END_S)
        self._save()

    def wait(self) -> None:
        """Keep the page until someone interrupts."""
        try:
            while self.alive:
                self._save()
                if self._idle.is_set():
                    self._post("ask")
                time.sleep(EVERY_S)
        except KeyboardInterrupt:
            pass

    def close(self) -> None:
        """End the viewer's process."""
        self._over.set()
        self._process.kill()  # it holds nothing that is not elsewhere
        self._process.join()
        self._thread.join()
        self._pipe.close()

    def _tell_if_due(self, within_step: bool = False) -> None:
        now = time.monotonic()
        if now - self._told_s >= EVERY_S and self._idle.is_set() and self.alive:
            self._told_s = now
            self._tell(within_step=within_step)

    def _tell(self, over: bool = False, within_step: bool = False) -> None:
        assert self._teller is not None
        assert self._last is not None
        self._post(self._teller.tell(*self._last, over, within_step))

    def _post(self, message: Message | str) -> None:
        self._idle.clear()
        self._outbox.put_nowait(message)

    def _save(self) -> None:
        while not self._pages.empty():
            page = self._pages.get_nowait()
            if self.on_save is not None:
                self.on_save(page)

    # --- the conversation's thread

    def _converse(self) -> None:
        """Send what is in the outbox, one message at a time, and take what was pressed meanwhile."""
        try:
            while not self._over.is_set():
                try:
                    message = self._outbox.get(timeout=EVERY_S)
                except queue.Empty:
                    continue
                self._pipe.send(message)
                for name, value in self._pipe.recv():
                    if name == PAUSE:
                        self._paused = bool(value)
                    elif name == SAVE:
                        self._pages.put(str(value))
                self._idle.set()
        except (OSError, EOFError):
            if not self._over.is_set():
                log.warning("the live view has ended; the run goes on without it")
        finally:
            self._over.set()
            self._paused = False
            self._idle.set()


def _serve(pipe: Connection, port: int) -> None:
    """Begin the page, in its own process: the run's never imports what draws it."""
    from dualslam.viewer.live_page import serve

    serve(pipe, port)
