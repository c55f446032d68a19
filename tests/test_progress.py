"""The progress bar: rates, the time left, and what it shows where."""

import io

import pytest

from dreamer_jax import progress as progress_module
from dreamer_jax.progress import Progress, reported


@pytest.fixture
def clock(monkeypatch):
    class Clock:
        now = 0.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(progress_module, "time", clock)
    return clock


def test_rates_count_the_time_of_their_own_work_and_the_time_left_counts_all(clock):
    stream = io.StringIO()
    with Progress(4000, 40, stream=stream, interval=0, description="run") as progress:
        for done in (1, 2):
            progress.update(phase="collecting")
            clock.now += 2.0
            progress.update(env_steps=1000 * done, last_return=-838.25)
            clock.now += 1.0  # something else
            progress.update(phase="updating")
            for update in range(10):
                clock.now += 0.25
                progress.update(updates=10 * (done - 1) + update + 1)
        assert progress.seconds_left() == pytest.approx(11.0)
    last = stream.getvalue().splitlines()[-1]
    assert last == (
        "run · updating 50% · 2,000/4,000 steps · return -838.2 · 500 steps/s · 4 updates/s"
        " · 0:11 left"
    )


def test_the_time_left_of_a_resumed_run_goes_by_what_it_did_itself(clock):
    with Progress(1000, 0, env_steps=800, stream=io.StringIO()) as progress:
        assert progress.seconds_left() is None
        clock.now += 10.0
        progress.update(env_steps=900)
        assert progress.seconds_left() == pytest.approx(10.0)
        progress.update(env_steps=1000)
        assert progress.seconds_left() == 0.0


def test_where_there_is_no_terminal_plain_lines_come_now_and_then(clock):
    stream = io.StringIO()
    with Progress(1000, 0, stream=stream, interval=30.0) as progress:
        for second in range(100):
            clock.now = float(second)
            progress.update(env_steps=second)
        progress.message("[bold] stays as it is")
    lines = stream.getvalue().splitlines()
    assert len(lines) == 4 + 1 + 1  # at 0, 30, 60 and 90 seconds, the message, the end
    assert "[bold] stays as it is" in lines
    assert "\x1b" not in stream.getvalue() and "\r" not in stream.getvalue()


def test_on_a_terminal_there_is_a_live_bar_that_fits_it(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("TERM", "xterm")

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    stream = Terminal()
    with Progress(1000, 10, stream=stream, description="hopper") as progress:
        progress.update(phase="collecting")
        progress.update(env_steps=500, updates=5, last_return=3.0)
        progress.message("a simulator was slow")
    shown = stream.getvalue()
    assert "hopper · collecting" in shown and "50%" in shown and "500/1,000 steps" in shown
    assert "a simulator was slow" in shown and "\x1b[2K" in shown


def test_a_run_without_updates_or_steps_is_no_division_by_zero():
    with Progress(0, 0, stream=io.StringIO()) as progress:
        progress.update(env_steps=0, updates=0)


def test_a_report_draws_a_bar_from_its_first_call_on(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with reported("playing"):
        pass
    assert "playing" not in capsys.readouterr().out
    with reported("playing") as report:
        report(1, 4, "")
        report(3, 4, "return 12")
    shown = capsys.readouterr().out
    assert "playing, return 12" in shown and "75%" in shown
