"""The stages of a search: how fast the machine is, sizes, other settings, one longer trial, full runs.

Every stage reads what is known from the record and asks for the next training; so a search that was interrupted takes
the same way again, past trainings that are done already.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from neuprim.config import RunConfig, task_of
from neuprim.config.target import Target
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.search.target.judge import ALLOWANCE, ROOM, Judge
from neuprim.search.target.knobs import ladders, next_turn, pays
from neuprim.search.target.pace import linear
from neuprim.search.target.prediction import NOISE, decibels
from neuprim.search.target.record import Attempt, Record, Turn
from neuprim.search.target.search import Proposal, climb, propose
from neuprim.search.target.trying import VIEWS, Trying
from neuprim.search.target.words import described, promised, shortfall

__all__ = ["Search"]

_SEARCH, _FULL = 0.33, 0.34
"""Shares of the budget for trials, and for a full run; what is left is for a second one, should the first miss."""

_SHORTER = 8
"""A trial has so many times fewer steps than the full run."""

_FEWEST = 16
"""Steps of the shortest trial that says anything."""

_PACE_STEPS = 24

_MOST_SIZES, _MOST_TURNS, _MOST_FULL = 6, 4, 5

_OVER, _NEAR = 0.3, 1.08
"""dB above the target that are close enough, if the size is within that of the one that would be closer: where decibels
come slowly, a tenth of one is a tenth of the bytes."""

_LEAST_SLOPE = 0.8
"""dB that twice as many primitives gain at least, in full runs of sizes that a target is met with; short trials may
show less."""

_BEYOND, _BELOW = 2.0, 3.0
"""How many times more, and fewer, primitives than any training had a full run may have: curves are not known further
away."""

_MORE = 1.25
"""How many times more primitives limits must allow for another full run to be worth it."""

_ENOUGH = 0.75
"""Of the steps of another full run, those with which it can be compared."""

_STEP = 1.07
"""From the size of a full run that missed to the next, at least."""

_LEAP = 2.0
"""Times as many primitives as any size tried has: before that is tried, one trial is longer."""

_SLOWER = 1.5
"""How many times slower than measured a full run may become before it is cut short."""


@dataclass
class Search:
    """One search, from its record on."""

    config: RunConfig
    target: Target
    dataset: Dataset
    record: Record
    trying: Trying

    @property
    def cap(self) -> float:
        """Steps that a full run may have."""
        return self.config.train.iterations or math.inf

    def steps(self, primitives: int) -> float:
        """Steps of a full run with so many primitives, in its share of the budget."""
        return min(self.cap, max(_FULL * self.record.asked["budget"] / self.trying.pace(primitives), 1.0))

    @property
    def judge(self) -> Judge:
        return Judge(self.target, self.record, self.steps)

    def run(self) -> None:
        kept = sum(a.outcome is not None for a in self.record.attempts)
        if kept:
            self.trying.tell(f"{kept} trainings of before are kept")
        stages = (self.measure_pace, self.sizes, self.say_what_is_out_of_reach, self.knobs, self.longer, self.full_runs)
        for number, stage in enumerate(stages, 1):
            if self.record.stage < number:
                stage()
                self.record.stage = number

    # ------------------------------------------------------------ trials

    def measure_pace(self) -> None:
        """A few steps, from which everything else is planned."""
        if self.record.length:
            return
        first = self.trying.run(Attempt("pace", {}, self.config.model.primitives, int(min(_PACE_STEPS, self.cap))))
        possible = self.steps(first.count)
        length = round(possible / _SHORTER)
        if length < 2 * _FEWEST:
            needed = 2 * _FEWEST * _SHORTER * self.trying.pace(first.count) / _FULL
            enough = "" if self.cap < 2 * _FEWEST * _SHORTER else f", or {needed:.0f} s"
            raise ConfigError(
                f"budget={self.record.asked['budget']:g}s: a full run of {first.count:,} primitives would have {possible:.0f} steps; expected "
                f"{2 * _FEWEST * _SHORTER} or more{enough}, fewer primitives to begin with (model.primitives) or smaller images"
            )
        self.record.length = length
        self.trying.tell(
            f"{1e3 * self.trying.pace(first.count):.1f} ms a step with {first.count:,} primitives: full runs of about {possible:,.0f} steps, trials of "
            f"{length:,}; one of {self.record.hold_out} training views judges"
        )

    def fits(self, primitives: int, steps: float, share: float = _SEARCH) -> bool:
        """Whether a trial ends within the share of the budget that all trials have."""
        return self.trying.spent + self.trying.cost(primitives, steps) <= share * self.record.asked["budget"]

    def highest(self) -> int:
        """Primitives whose full run would still have twice the steps of a trial, and that limits allow."""
        low = high = self.config.model.primitives
        while self.steps(high) > 2 * self.record.length and high < 2**24:
            low, high = high, 2 * high
        while high - low > max(low // 50, 1):
            middle = (low + high) // 2
            low, high = (middle, high) if self.steps(middle) > 2 * self.record.length else (low, middle)
        offered = [a.count for a in self.record.done("size") if a.count < 0.95 * a.primitives]
        limit = self.judge.most()
        return max(1, min([low, *offered, *([] if limit is None else [limit])]))

    def probe(self, primitives: int) -> None:
        """A size at two lengths, so that what more steps bring is known."""
        words = self.record.words
        self.told(
            *(Attempt("size", words, primitives, steps) for steps in (self.record.length // 2, self.record.length))
        )

    def told(self, *attempts: Attempt) -> None:
        for several in [attempts] if self.trying.together else [(attempt,) for attempt in attempts]:
            known = [self.trying.known(attempt) for attempt in several]
            for before, done in zip(known, self.trying.run_all(several), strict=True):
                if not before:
                    self.trying.tell(described(done, self.judge.predicted(done.count)))

    def sizes(self) -> None:
        """Sizes, until the one that meets the target is known, the budget's share is used or the target is out of
        reach."""
        first = min(self.config.model.primitives, self.highest())
        self.probe(first)
        if self.longer_trials():
            self.probe(first)
        begun = list(
            dict.fromkeys(
                a.primitives for a in self.record.attempts if a.purpose == "size" and a.words == self.record.words
            )
        )
        for count in begun:  # before an interruption
            self.probe(count)
        for _ in range(_MOST_SIZES - len(begun)):
            proposal = self.proposal()
            if self.promising() is not None:
                break
            if self.target.quality and self.far(proposal) and self.look_further():
                continue
            if proposal.kind != "try":
                break
            if not self.fits(proposal.primitives, 1.5 * self.record.length):
                self.because("no time for more sizes")
                break
            if any(
                a.primitives == proposal.primitives and a.words == self.record.words for a in self.record.done("size")
            ):
                break
            self.probe(proposal.primitives)

    def longer_trials(self) -> bool:
        """Doubles the trials' length while a step turns out to be faster than the first few had it."""
        before = self.record.length
        if self.record.turns or len(self.record.done("size")) > 2:
            return False
        while self.steps(self.config.model.primitives) >= 1.9 * _SHORTER * self.record.length:
            self.record.length *= 2
        return self.record.length > before

    def far(self, proposal: Proposal) -> bool:
        """Whether a proposal leaps, or gives up, by what short trials say of long runs: networks of light gain more
        with every doubling for long."""
        largest = max(a.count for a in self.record.done("size"))
        return proposal.kind == "unreachable" or (proposal.kind == "try" and proposal.primitives > _LEAP * largest)

    def look_further(self) -> bool:
        """Trains the largest size tried for twice as long, once; whether it did."""
        largest = max(a.primitives for a in self.record.done("size"))
        steps = 2 * self.record.length
        if self.record.done("longer") or steps > self.steps(largest) or not self.fits(largest, steps):
            return False
        self.told(Attempt("longer", self.record.words, largest, steps))
        return True

    def promising(self) -> int | None:
        """Where no size seems to have the target, and before full runs: the least that is as good as any tried, if it
        may have it by the doubt about it. A full run of it tells more than trials of larger ones."""
        judge = self.judge
        if not self.target.quality or self.record.done("full") or len(judge.tried()) < 2:
            return None
        if judge.curve().count_for(ALLOWANCE, 1, self.highest()) is not None:
            return None
        best = max(margin for _, margin in judge.tried())
        return (
            min(n for n, margin in judge.tried() if margin >= best - NOISE) if best + judge.doubt >= ALLOWANCE else None
        )

    def proposal(self) -> Proposal:
        judge, highest = self.judge, self.highest()
        if not self.target.quality:
            return climb(judge.tried(), 1, highest)
        return propose(judge.tried(), 1, highest, ALLOWANCE, judge.doubt)

    def because(self, text: str) -> None:
        if text not in self.record.why:
            self.record.why.append(text)

    def wanted(self) -> int:
        """The size that a full run should have, by what is known now."""
        judge, highest = self.judge, self.highest()
        if not self.target.quality:
            proposal = climb(judge.tried(), 1, highest)
            return proposal.primitives if proposal.kind == "take" else highest
        curve, tried, known = judge.curve(), judge.tried(), min(judge.tried())[0]
        found = self.promising() or curve.count_for(ALLOWANCE, 1, highest)
        top, best = max(tried)[0], max(tried, key=lambda pair: pair[1])[0]
        if found is not None and found <= _BEYOND * top:
            return self.beside(max(found, min(round(known / _BELOW), highest), self.down_to()))
        more = min(highest, round(_BEYOND * top))
        if found is None and (best < top or self.steps(more) < _ENOUGH * self.steps(top)):
            return min(best, highest)  # more primitives would only have fewer steps
        return self.beside(more)

    def down_to(self) -> int:
        """The size below which another full run need not be, while all of them have more than the target: short trials
        of sizes far apart are often alike, and full runs are not."""
        full = [
            (a.count, self.judge.margin({name: a.quality(name) for name in self.judge.measures}))
            for a in self.record.done("full")
        ]
        if not full or min(margin for _, margin in full) < ROOM:
            return 1
        count, margin = min(full)
        return round(count / 2 ** ((margin - ROOM) / _LEAST_SLOPE))

    def beside(self, found: int) -> int:
        """``found``, but no nearer to a full run that missed than makes a difference, on the side that it missed on."""
        for attempt in self.record.done("full"):
            margin = self.judge.margin({name: attempt.quality(name) for name in self.judge.measures})
            if margin < ROOM:
                found = max(found, math.ceil(attempt.count * _STEP))
            elif margin > _OVER and attempt.count > 1:
                found = min(found, math.floor(attempt.count / _STEP))
        return max(found, 1)

    def knobs(self) -> None:
        """Other settings that save bytes, each tried once at the size tried that is nearest to the one wanted."""
        if self.record.out_of_reach or not (self.target.quality or self.target.megabytes is not None):
            return  # nothing is gained by saving bytes
        known = ladders(self.config, task_of(self.config), self.dataset)
        for _ in range(_MOST_TURNS):
            turn = next_turn(known, self.record.turns)
            if turn is None:
                return
            key, before, after = turn
            wanted = self.wanted()
            bases = [
                a
                for a in self.record.done("size", "knob")
                if a.words == self.record.words and a.steps == self.record.length
            ]
            if not bases:
                return
            base = min(bases, key=lambda a: abs(math.log2(a.count / wanted)))
            if not self.fits(base.primitives, self.record.length):
                self.because("no time to try other settings")
                return
            words = {**self.record.words, key: after}
            tried = self.trying.run(Attempt("knob", words, base.primitives, self.record.length))
            loss = {
                name: decibels(name, base.quality(name)) - decibels(name, tried.quality(name))
                for name in ("psnr", "ssim")
            }
            size = (tried.packed / tried.count) / (base.packed / base.count)
            slope = max(self.judge.curve().slope_at(wanted), 0.2)
            adopted = pays(max(loss[name] for name in self.judge.measures), size, slope)
            self.record.turns.append(Turn(key, before, after, loss, size, adopted))
            self.trying.write()
            kept = "kept" if adopted else "not worth it"
            self.trying.tell(f"{key}={after}: {size:.0%} of the bytes, {-loss['psnr']:+.2f} dB; {kept}")

    def longer(self) -> None:
        """The size wanted for twice as long: what more steps bring is surest from the longest."""
        steps = 2 * self.record.length
        if self.record.done("longer") or self.record.done("full"):
            return
        wanted = self.wanted()
        near = [
            a.primitives
            for a in self.record.done("size", "knob")
            if a.words == self.record.words and a.steps == self.record.length
        ]
        count = min(near, key=lambda n: abs(math.log2(n / wanted)), default=wanted)
        if steps > self.steps(count) or not self.fits(count, steps, _SEARCH + 0.07):
            return
        self.told(Attempt("longer", self.record.words, count, steps))

    # ------------------------------------------------------------ full runs

    def full_runs(self) -> None:
        """One full run, and others of a better size while the target is missed, or met with more than it needs, and
        time is left."""
        for _ in range(_MOST_FULL - (len(self.record.done("full")) - self.record.before)):
            done = self.record.done("full")
            unfinished = [a for a in self.record.attempts if a.purpose == "full" and a.outcome is None]
            if unfinished:
                attempt = unfinished[-1]
            else:
                if any(self.close(a) for a in done):
                    return
                planned = self.plan()
                if planned is None:
                    return
                attempt = planned
            expected = ", ".join(promised(name, *pair) for name, pair in attempt.predicted.items())
            self.trying.tell(
                f"full run: {attempt.primitives:,} primitives, {attempt.steps:,} steps; expected {expected}"
            )
            done_now = self.trying.run(attempt)
            self.trying.tell(described(done_now, {}))

    def close(self, attempt: Attempt) -> bool:
        """Whether a full run is as good as another could hope to be."""
        if not self.target.quality:
            return shortfall(self.target, attempt) is None and self.wanted() <= _MORE * attempt.count
        margin = self.judge.margin({name: attempt.quality(name) for name in self.judge.measures})
        return (
            ROOM <= margin <= _OVER
            and attempt.count <= _NEAR * self.wanted()
            and shortfall(self.target, attempt) is None
        )

    def plan(self) -> Attempt | None:
        """The next full run; None where another would not change anything, or has no time."""
        done = self.record.done("full")
        number, reserve = len(done), self.reserve()
        left = self.trying.left - reserve
        share = left if number else max(left / 2, min(left, _FULL * self.record.asked["budget"]))
        wanted = self.wanted()
        least = self.record.length * (4 if number else 1)
        steps = int(min(self.cap, share / self.trying.pace(wanted)))
        if number and steps < max(least, _ENOUGH * done[-1].steps):
            self.because(f"no time for another full run: {max(left, 0):.0f} s are left")
            return None
        if number and any(abs(math.log2(wanted / a.count)) < math.log2(_STEP) / 2 for a in done):
            self.because("another size promises nothing better")
            return None
        steps = max(steps, least)
        seconds = round(
            max(min(_SLOWER * steps * self.trying.pace(wanted), left), 0.02 * self.record.asked["budget"], 1.0), 1
        )
        return Attempt("full", self.record.words, wanted, steps, seconds, self.judge.predicted(wanted))

    def reserve(self) -> float:
        """Seconds for what follows a full run: measuring, pictures, storing in few bits."""
        trials = self.record.done("size", "longer", "full")
        frame = linear([(a.count, a.quality("ms_per_frame")) for a in trials], self.wanted()) / 1e3
        held = min(VIEWS, len(self.dataset.train) // self.record.hold_out)
        frames = 6 * held + 3 * len(self.dataset.test) + 40
        return 2 * frame * frames + 2 * max(self.trying.overhead(), 0.0)

    def say_what_is_out_of_reach(self) -> None:
        """One line as soon as it is known."""
        if not self.target.quality:
            return
        self.record.out_of_reach = None
        judge, best = self.judge, self.wanted()
        if max(judge.curve().at(best), *(margin for _, margin in judge.tried())) + judge.doubt < ALLOWANCE:
            found = ", ".join(promised(name, *pair) for name, pair in judge.predicted(best).items())
            limits = judge.most()
            limit = "the limits allow" if limits is not None and self.highest() == limits else "the budget can train"
            self.record.out_of_reach = (
                f"{self.target} is out of reach: {found} is the best that {limit}, of {best:,} primitives; that is made"
            )
            self.trying.tell(self.record.out_of_reach)
