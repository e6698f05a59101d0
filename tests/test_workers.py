"""Items streamed through worker processes; light imports, since a worker repeats them."""

import os
import sys

from sdfhub.data.workers import THREADS, _startable, stream_in_processes


class DiesElsewhere:
    """A square, or the end of the process unless it is the one that it was made in."""

    def __init__(self):
        self.home = os.getpid()

    def __call__(self, number: int) -> int:
        if number == 6 and os.getpid() != self.home:
            os._exit(1)
        return number**2


def test_a_stream_takes_items_one_by_one_keeps_their_order_and_survives_its_workers():
    taken = []
    items = (taken.append(number) or number for number in range(10))
    stream = stream_in_processes(DiesElsewhere(), items, workers=1)
    assert next(stream) == 0
    assert len(taken) <= 3
    assert list(stream) == [number**2 for number in range(1, 10)]


def test_what_other_threads_do_while_workers_start_stays(monkeypatch):
    monkeypatch.setenv(THREADS[0], "7")
    monkeypatch.delenv(THREADS[1], raising=False)
    monkeypatch.delenv("SDFHUB_SET_MEANWHILE", raising=False)
    main = sys.modules["__main__"]
    with _startable(len):
        assert os.environ[THREADS[0]] == os.environ[THREADS[1]] == "1"
        assert sys.modules["__main__"] is not main
        monkeypatch.setenv("SDFHUB_SET_MEANWHILE", "yes")
        monkeypatch.setitem(sys.modules, "imported_meanwhile", main)
    assert os.environ[THREADS[0]] == "7" and THREADS[1] not in os.environ
    assert os.environ["SDFHUB_SET_MEANWHILE"] == "yes" and "imported_meanwhile" in sys.modules
    assert sys.modules["__main__"] is main
