"""Does a newer request cancel an older one, and a fine image never hold up a drag?"""

import threading
import time
from typing import Any

from jaxvol.app.viewer.model import Model


class Log(Model):
    """A model of numbers that waits to be let go on, and what it did."""

    def __init__(self, parts: int = 4, idle_delay: float = 0.0):
        self.done: list[tuple[str, int]] = []
        self.told: list[str] = []
        self.gate = threading.Semaphore(0)
        self.parts = parts
        none: Any = None
        self.idle_delay = idle_delay
        super().__init__(none, none, none, self.told.append)

    def ask(self, request: Any):
        super().ask(request)

    def _draw(self, request: Any):
        if request < 0:
            raise ValueError("negative")
        self.gate.acquire()
        self.done.append(("coarse", request))
        yield
        try:
            for part in range(self.parts):
                self.gate.acquire()
                self.done.append((f"part {part}", request))
                yield
        finally:
            self.done.append(("closed", request))

    def go(self, times: int = 1):
        self.gate.release(times)

    def until(self, count: int):
        end = time.monotonic() + 20
        while len(self.done) < count:
            assert time.monotonic() < end, self.done
            time.sleep(0.001)


def test_a_newer_request_cancels_a_fine_image_between_two_parts():
    log = Log()
    log.ask(1)
    log.go(3)
    log.until(3)
    log.ask(2)  # while it waits in part 2
    log.go()
    log.go(5)
    assert log.wait(20)
    assert log.done[:5] == [("coarse", 1), ("part 0", 1), ("part 1", 1), ("part 2", 1), ("closed", 1)]
    assert log.done[5] == ("coarse", 2)
    assert log.done[-2:] == [("part 3", 2), ("closed", 2)]
    log.close()


def test_of_many_requests_the_one_begun_is_finished_and_the_last_one_follows():
    log = Log(idle_delay=60)
    log.ask(1)
    while log._next is not None:
        time.sleep(0.001)
    for request in range(2, 50):
        log.ask(request)
    log.go(2)
    log.until(2)
    assert log.done == [("coarse", 1), ("coarse", 49)]
    log.ask(50)  # at once, though the rest has not passed
    log.go()
    log.until(3)
    assert log.done[-1] == ("coarse", 50)
    begun = time.monotonic()
    log.close()
    assert time.monotonic() - begun < 20


def test_a_fault_is_told_and_the_next_request_drawn():
    log = Log()
    log.ask(-1)
    assert log.wait(20)
    assert log.told == ["not drawn:\nnegative"]
    log.ask(3)
    log.go(5)
    assert log.wait(20)
    assert ("coarse", 3) in log.done
    log.close()
    assert log.wait(0)
