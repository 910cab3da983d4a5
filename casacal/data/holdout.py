"""Rows held out of a fit, by which it is judged: single ones, whole faces, regions of postures, whole sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from casacal.data.columns import Labels, combinations
from casacal.data.samples import Measurements, Samples
from casacal.errors import CasacalError, UnknownNameError, came
from casacal.linalg import svd
from casacal.values import Array, Index, Rows, is_real
from casacal.wording import counted

WAYS = ("rows", "region", "face")  # units that are held out whole, apart from values of a column


def split(
    samples: Samples, holdout: float, seed: int, by: str = "rows", face: str | None = None
) -> tuple[Index, Index]:
    """Rows to fit and rows held out: a given part of them, 0 to below 1, drawn at random.

    by: "rows" of each face, one by one; "region", on each face the rows whose postures are nearest to one of them;
    "face", whole faces; or a column of the samples, all rows of some of its values. face: the column that names the
    faces; None where there is one for all.

    Raises CasacalError for other parts, where nothing is left to fit, and where there is nothing to hold out.
    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise CasacalError(f"The seed is {seed!r}", "Give a whole number from zero on")
    part = "Give a fraction from 0 to below 1, such as 0.3"
    if not is_real(holdout):
        raise CasacalError(f"Got {came(holdout)} as the held-out part", part)
    if not 0 <= holdout < 1:
        raise CasacalError(f"The held-out part is {holdout:g}", part)
    if not isinstance(by, str):
        raise CasacalError(f"Got {came(by)} as what is held out together", f"Give {', '.join(WAYS)} or a column")
    rng = np.random.default_rng(seed)
    if by in ("rows", "region"):
        mask = _of_each_label(samples, holdout, rng, near=by == "region")
    else:
        mask = _whole(samples, holdout, rng, by, face)
    return np.flatnonzero(~mask), np.flatnonzero(mask)


def split_each(
    measured: Measurements, holdout: float, seed: int, by: str, faces: Sequence[str | None]
) -> tuple[Index, Index]:
    """Rows held out of several instruments, each by itself; one without the column is fitted whole."""
    parts, refused = [], list[CasacalError]()
    for some, face in zip(measured.sets, faces, strict=True):
        try:
            parts.append(split(some, holdout, seed, by, face))
        except CasacalError as error:
            if len(measured.sets) == 1:
                raise
            refused.append(error)
            parts.append((np.arange(len(some)), np.zeros(0, dtype=np.intp)))
    if len(refused) == len(parts):
        raise refused[0]
    joined = ((rows[k] + first for rows, first in zip(parts, measured.starts, strict=False)) for k in (0, 1))
    fitted, held = (np.concatenate(list(each)) for each in joined)
    return fitted, held


def _of_each_label(samples: Samples, holdout: float, rng: np.random.Generator, *, near: bool) -> Rows:
    """The given part of each label's rows (N,): at random, or those nearest to one of them, itself among them."""
    distinct, codes = combinations(list(samples.labels.values()), len(samples))
    mask, wanted = np.zeros(len(samples), dtype=bool), 0.0
    for k, labels in enumerate(distinct):
        rows = np.flatnonzero(codes == k)
        wanted += holdout * len(rows)  # of the labels so far: what one rounds away the next makes good
        order = rng.permutation(rows)
        if near:
            joints = samples.joints[rows]
            spread = joints.std(axis=0)  # each joint in units of its own
            away = (joints - samples.joints[order[0]]) / np.where(spread > 0, spread, 1.0)
            order = rows[np.argsort((away**2).sum(axis=1), kind="stable")]
        if round(holdout * len(rows)) == len(rows):
            shown = " ".join(labels) or "all rows"
            raise CasacalError(f"Holding out {holdout:g} leaves no row of '{shown}' to fit", "Hold fewer rows out")
        mask[order[: min(max(round(wanted) - int(mask.sum()), 0), len(rows) - 1)]] = True
    if holdout and not mask.any():
        what = f"Holding out {holdout:g} of {counted(len(samples), 'row')} holds none out"
        raise CasacalError(what, "Hold more out, or take more rows of each label")
    return mask


def _whole(samples: Samples, holdout: float, rng: np.random.Generator, by: str, face: str | None) -> Rows:
    """All rows (N,) of about the given part of the groups, at least of one; none where nothing is to be held out."""
    if by == "face":
        if face is None or face not in samples.labels:
            raise CasacalError("Faces were to be held out, and these samples name none", "Hold out rows or a region")
        groups = samples.labels[face]
    elif by in samples.labels:
        groups = samples.labels[by]
    elif by in samples.extra:
        groups = Labels.of(str(value).strip() for value in samples.extra[by])
    else:
        raise UnknownNameError("way to hold out", by, [*WAYS, *samples.labels, *samples.extra])
    if not holdout:
        return np.zeros(len(samples), dtype=bool)
    count = max(1, round(holdout * len(groups.names)))
    if count >= len(groups.names):
        what = f"Holding out {count} of {len(groups.names)} by '{by}' leaves nothing to fit"
        raise CasacalError(what, "Hold fewer out")
    return np.isin(groups.codes, rng.permutation(len(groups.names))[:count])


FACES, REGIONS, INSTRUMENTS = "faces", "regions", "instruments"  # splits of any samples; others are named by columns

MOST_PARTS = 12  # parts of a split; where labels are more, some are left out together
HALVINGS = 2  # how often the postures are halved into regions


def splits(samples: Samples, face: str | None) -> dict[str, list[Index]]:
    """Rows that are left out together, by the name of the split: faces, regions, values of further columns."""
    columns = {FACES if name == face else name: labels for name, labels in samples.labels.items()}
    return splits_by(columns, samples.joints)


def splits_by(columns: Mapping[str, Labels], joints: Array) -> dict[str, list[Index]]:
    """Rows (k,) of each part of each split: by labels (N,) of some columns, and by regions of joint values (N, q)."""
    found = {}
    for name, labels in columns.items():
        groups = np.array_split(np.arange(len(labels.names)), min(MOST_PARTS, len(labels.names)))
        if len(groups) > 1:
            found[name] = [np.flatnonzero(np.isin(labels.codes, group)) for group in groups]
    regions, spread = [np.arange(len(joints))], joints.std(axis=0)
    for _ in range(HALVINGS):  # by the middle of the direction in which their postures spread most, joints all alike
        halves = list[Index]()
        for rows in regions:
            places = joints[rows] / np.where(spread > 0, spread, 1.0)
            places = places - places.mean(axis=0)
            order = rows[np.argsort(places @ svd(places)[2][0], kind="stable")]
            halves += [np.sort(order[: len(order) // 2]), np.sort(order[len(order) // 2 :])]
        regions = [half for half in halves if half.size]
    if len(regions) > 1:
        found[REGIONS] = regions
    return found
