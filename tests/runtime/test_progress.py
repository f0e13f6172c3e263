"""Progress of loops."""

from invertwin.runtime import progress
from invertwin.runtime.progress import progress_callback, track


def test_a_listener_hears_of_the_outer_loop_with_the_time_left(monkeypatch):
    clock = iter([10.0, 12.0, 13.0, 19.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    heard = []
    with progress_callback(lambda *row: heard.append(row)):
        for _ in track("abc", "outer"):
            assert list(track(range(2), "inner")) == [0, 1]
    assert heard == [("outer", 1, 3, 4.0), ("outer", 2, 3, 1.5), ("outer", 3, 3, 0.0)]


def test_nobody_need_listen():
    assert list(track([4, 5], "work")) == [4, 5]


def test_a_loop_that_breaks_off_leaves_the_next_one_audible():
    heard = []
    with progress_callback(lambda name, *_: heard.append(name)):
        parts = track(range(3), "first")
        next(parts)
        parts.close()
        list(track(range(1), "second"))
    assert heard == ["second"]
