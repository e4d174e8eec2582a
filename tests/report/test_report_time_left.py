"""The time left follows the model at first, and the run's own pace as the fit goes on."""

from __future__ import annotations

import pytest

from gnrecon.report.time_left import TimeLeft


class Run:
    """A run whose clock the test moves."""

    def __init__(self) -> None:
        self.now = 100.0
        self.left = TimeLeft(lambda: self.now)

    def fit(self, seconds: float, expected: float, shares: int = 10) -> list[float]:
        """Fit in equal steps, and return the predictions of the end of the fit and of the mesh of 20 s at each."""
        self.left.expect(expected, 20)
        self.left.stage("fit")
        found = []
        for step in range(1, shares + 1):
            self.now += seconds / shares
            self.left.advance(step / shares)
            assert self.left.seconds is not None
            found.append(self.left.seconds)
        return found


def test_nothing_is_known_before_the_fit_or_without_a_model() -> None:
    run = Run()
    run.left.stage("read")
    run.left.advance(0.5)
    assert run.left.seconds is None
    run.left.stage("fit")
    assert run.left.seconds is None
    assert run.left.describe() == ""


def test_a_run_that_meets_the_model() -> None:
    run = Run()
    run.left.expect(40, 20)
    run.left.stage("fit")
    assert run.left.describe() == "about 60 s left"
    assert run.fit(40, 40) == pytest.approx([60 - 4 * step for step in range(1, 11)])
    run.left.stage("extract")
    assert run.left.seconds == pytest.approx(20)
    run.now += 18
    run.left.stage("project")
    assert run.left.describe() == "a few seconds left"
    run.now += 100
    assert run.left.seconds == 0


@pytest.mark.parametrize("factor", [0.4, 3.0])
def test_the_pace_of_the_run_corrects_the_model(factor: float) -> None:
    run = Run()
    found = run.fit(40 * factor, 40)
    truth = [40 * factor * (1 - step / 10) + 20 * factor for step in range(1, 11)]
    errors = [abs(guess / true - 1) for guess, true in zip(found, truth, strict=True)]
    assert errors[-1] < 0.01
    assert max(errors[5:]) < max(errors[:5])


def test_a_fit_that_stands_still_is_not_nearly_done() -> None:
    run = Run()
    run.fit(8, 40, shares=2)
    run.left.stage("fit")
    run.now += 5
    run.left.advance(0.1)
    before = run.left.seconds
    run.now += 500
    assert before is not None
    assert run.left.seconds is not None
    assert run.left.seconds > before


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(2, "a few seconds left"), (38, "about 40 s left"), (290, "about 5 min left"), (7300, "2.0 h")],
)
def test_the_words(seconds: float, words: str) -> None:
    run = Run()
    run.left.expect(seconds, 0)
    run.left.stage("fit")
    assert words in run.left.describe()
