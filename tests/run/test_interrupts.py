from __future__ import annotations

import signal

import pytest

from dualslam.run.interrupts import ENDING, Interrupts, held_back


@pytest.mark.parametrize("number", ENDING)
def test_the_first_asks_the_second_leaves_and_the_third_acts_as_ever(number: signal.Signals) -> None:
    came: list[int] = []
    before = signal.signal(number, lambda got, _: came.append(got))
    try:
        with Interrupts() as interrupts:
            with interrupts.leave_at_second():
                signal.raise_signal(number)
                assert interrupts.asked
                signal.raise_signal(number)
                pytest.fail("the second one leaves")
            assert came == []
            signal.raise_signal(number)
            assert came == [number]
    finally:
        signal.signal(number, before)


def test_held_back_it_acts_behind() -> None:
    done = []

    def load() -> None:
        with held_back():
            signal.raise_signal(signal.SIGINT)
            done.append("the block")

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        load()
    assert done == ["the block"]
    assert signal.getsignal(signal.SIGINT) is before
    with held_back():
        pass


def test_what_must_not_be_left_is_not() -> None:
    before = signal.getsignal(signal.SIGINT)
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        with interrupts.leave_at_second():
            pass
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(KeyboardInterrupt):
        interrupts.act_late()


def test_an_interrupt_that_is_none_of_ours_goes_through() -> None:
    with pytest.raises(KeyboardInterrupt), Interrupts() as interrupts, interrupts.leave_at_second():
        raise KeyboardInterrupt
    interrupts.act_late()


def test_a_handler_that_is_not_pythons_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGHUP)
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    with Interrupts():
        pass
    monkeypatch.undo()
    assert signal.getsignal(signal.SIGHUP) is before


def test_what_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupts() as interrupts:
            signal.raise_signal(signal.SIGHUP)
            assert not interrupts.asked
    finally:
        signal.signal(signal.SIGHUP, before)
