"""A term beside the geometry: its unknowns, what it changes, and what the fitted rows say of themselves for it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from casacal.data.samples import Samples
from casacal.model.geometry import fitted_plane
from casacal.model.instrument import Instrument
from casacal.model.kinematics import Expression
from casacal.model.links import Links
from casacal.model.robot import Robot
from casacal.model.unknown import Parameter
from casacal.user_code import Portable
from casacal.values import Array, FrozenMapping


@dataclass(frozen=True, eq=False)
class FaceFrame:
    """Frame of a face from its touches: centre (3, mm), two directions in it (2, 3), half widths (2, mm)."""

    centre: Array
    axes: Array
    half: Array

    @staticmethod
    def of(tips: Array) -> FaceFrame:
        """Frame of the nominal tips (N, 3; mm) on a face."""
        plane = fitted_plane(tips)
        places = (tips - plane.centre) @ plane.across.T
        low, high = places.min(axis=0), places.max(axis=0)
        centre = plane.centre + (low + high) / 2 @ plane.across
        return FaceFrame(centre, plane.across, np.maximum((high - low) / 2, 1.0))

    def places(self, tips: Array) -> Array:
        """Coordinates (N, 2) of tips (N, 3; mm) on the face, -1 to 1 from edge to edge."""
        return np.asarray((tips - self.centre) @ (np.column_stack([*self.axes]) / self.half))


@dataclass(frozen=True)
class Survey:
    """Places of the fitted rows, and the order in which they were measured."""

    faces: Mapping[str, FaceFrame]  # frames of the faces touched three times or more, by label
    lines: tuple[int, ...]  # of the rows in order, or of some, evenly over all: when a row was is a matter of rows
    samples: Samples  # the rows themselves, or, of very many, some of them

    @staticmethod
    def of(samples: Samples, tips: Array, instrument: Instrument) -> Survey:
        """Survey of samples with nominal tips (N, 3; mm) on an instrument's faces; a step lies in its face's frame."""
        rows = samples.faces(instrument.groups).rows()
        on = {name: instrument.instance("", name) for name in rows}
        own = {name: FaceFrame.of(tips[rows[name]]) for name in rows if len(rows[name]) >= FEWEST}
        faces = {name: own[on[name]] for name in rows if on[name] in own}
        some = np.unique(np.linspace(0, len(samples) - 1, MANY).astype(int))
        order = tuple(np.sort(np.asarray(samples.lines))[some].tolist())
        return Survey(FrozenMapping(faces), order, samples.take(some) if len(samples) > MANY else samples)

    def places(self, samples: Samples, tips: Array, label: str | None) -> Array:
        """Coordinates (N, 2) of rows on their faces, -1 to 1; the middle of a face that was not fitted."""
        found = np.zeros((len(samples), 2))
        for name, rows in samples.faces(label).rows().items():
            if name in self.faces:
                found[rows] = self.faces[name].places(tips[rows])
        return found

    def when(self, samples: Samples) -> Array:
        """Place (N,) of samples between the first (0) and the last (1) row that was fitted; none lies beyond."""
        places = np.arange(len(self.lines)) / max(len(self.lines) - 1, 1)
        return np.interp(np.asarray(samples.lines, dtype=np.float64), self.lines, places)


MANY = 2_000  # rows that stand for all of them
FEWEST = 3  # touches that say where a face lies


@dataclass(frozen=True)
class SurveyedRows:
    """Rows of an instrument with nominal tips and a survey, as terms see them before anything is fitted."""

    samples: Samples
    tips: Array  # nominal tips (N, 3; mm)
    survey: Survey  # survey of the rows that are fitted, these or others


@dataclass(frozen=True)
class Site:
    """The robot and instrument for which a term is evaluated."""

    robot: Robot
    instrument: Instrument

    @cached_property
    def links(self) -> Links:
        """Screws and places of the arm's links; ProblemError where joints do not carry one another in order."""
        return Links.of(self.robot)

    @cached_property
    def components(self) -> int:
        """Components of the residual in the unit in which the instrument speaks; one where it cannot be built."""
        instrument = self.instrument
        if blocks := instrument.blocks:
            return sum(block.size for block in blocks if block.unit == instrument.words.unit)
        from casacal.model.traced_instrument import TracedInstrument

        try:
            return int(TracedInstrument.of(instrument, self.robot.parameters).graph.numel_out(0))
        except Exception:  # whatever a user's function raises is said where the arm is traced
            return 1


@dataclass(frozen=True)
class Here(Site):
    """One row in symbols, as terms see it."""

    p: Any  # values of all unknowns by name, those of the terms among them
    q: Expression  # joint values (n; rad, mm) as the controller says
    pose: Expression  # flange pose (4x4, mm), with the terms that came before
    row: Any  # columns by name: those that were read, and those that terms ask for


class Term(Portable, ABC):
    """Something that rows may show and that no parameter of arm or instrument describes.

    Its unknowns are zero at the nominal; their priors say how far they may be from it. A subclass, best a frozen
    dataclass, says `key`, `words` and `moves`, and gives `unknowns` and any of `joints`, `pose`, `reading`, `residual`.
    """

    elsewhere: ClassVar[float] = 0.0
    """Value of its columns at postures that are no rows, where the tip is asked for."""
    moves: ClassVar[bool] = False
    """Whether it moves the tip itself, alike for all instruments, or only what one of them reads of it."""
    lasting: ClassVar[bool] = False
    """Whether an instrument errs by it alike in every session, as by the gain of its dial."""

    @property
    @abstractmethod
    def key(self) -> str:
        """Prefix of the names of its unknowns."""

    @property
    @abstractmethod
    def words(self) -> str:
        """Name in reports."""

    @abstractmethod
    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Its unknowns, by key, with a nominal of zero; none where it means nothing to this robot or instrument."""

    def columns(self, site: Site) -> tuple[str, ...]:
        """Names of what it wants to know of each row beside what the instrument reads."""
        del site
        return ()

    def values(self, site: Site, rows: SurveyedRows) -> Mapping[str, Array]:
        """Values (N,) of `columns` for some rows."""
        return self.told(site, rows.samples)

    @property
    def further(self) -> tuple[str, ...]:
        """Columns of a file that give the first of `columns`, in their order; the others are then zero.

        Rows that have them can be predicted with the term; none where only the fitted rows determine it.
        """
        return ()

    def told(self, site: Site, samples: Samples) -> Mapping[str, Array]:
        """Values (N,) of `columns`, from the columns `further` of any rows; ProblemError where those are invalid."""
        del site, samples
        return {}

    def away(self, site: Site) -> Mapping[str, float]:
        """Values of those columns at postures that are not samples, where the tip is evaluated."""
        return dict.fromkeys(self.columns(site), self.elsewhere)

    def joints(self, here: Here) -> Expression | None:
        """Deviations of the joints (n; rad, mm) from what the controller shows."""
        del here
        return None

    def pose(self, here: Here) -> Expression | None:
        """The flange pose (4x4, mm) as it truly is."""
        del here
        return None

    def reading(self, here: Here) -> Mapping[str, Expression]:
        """Corrections of columns that were read, by name."""
        del here
        return {}

    def residual(self, here: Here) -> Expression | None:
        """Correction of the residual, in its unit: one for all components, or one for each."""
        del here
        return None

    def check(self) -> None:
        """Raise ProblemError where it is declared as it cannot be; asked once it is part of a problem."""
