"""The seven gates of the page as data: what each shows, whether it is passed, what is missing and what it is for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from casacal.data.samples import WRITTEN
from casacal.errors import CasacalError, SimulationError
from casacal.model.instrument import readings_within
from casacal.planning.candidates import cell_of
from casacal.planning.route import CHECK, joints_shown, touches_needed
from casacal.planning.scene import scene
from casacal.shopfloor.conversation import (
    doubt,
    ended,
    help_words,
    in_units,
    to_expect,
    too_many_corrected,
    waiting,
)
from casacal.shopfloor.recording import Recording
from casacal.shopfloor.session import Session
from casacal.shopfloor.touch import SHOWN, rows_of
from casacal.simulation.cell import Cell
from casacal.tablet.asked import ENOUGH_POSES, ORIENTATIONS
from casacal.tablet.work import Work, for_page, unforeseen
from casacal.wording import counted, figures, mm, sentence

PASSED, OPEN, AHEAD = "passed", "open", "ahead"
"""What a gate may be: done; to be done; not possible before another one."""
PURPOSES = {"fit": "", "again": "once more", "check": "kept to verify"}


def document(work: Work) -> dict[str, Any]:
    """Everything that a window shows, in JSON's own types; `version` names this state."""
    with work.lock:
        problem, layout = work.source.problem, work.source.problem.layout()
        gates = {name: _shown(work, gate) for name, gate in GATES.items()}
        for name, gate in gates.items():
            gate["missing"] = for_page(gate["missing"])
            gate |= {"said": list(map(for_page, work.said.get(name, ()))), "failed": work.failed.get(name, False)}
        return {
            "version": work.version,
            "run": work.run,
            "job": work.job,
            "name": work.source.name,
            "robot": problem.robot.name,
            "joints": [f"q{k}{WRITTEN[kind][0].replace('_', ' ')}" for k, kind in enumerate(layout.joints, 1)],
            "files": [name for name, path in files(work).items() if path.is_file()],
            "trouble": for_page(work.trouble),
            "gates": gates,
        }


def _shown(work: Work, gate: Callable[[Work], dict[str, Any]]) -> dict[str, Any]:
    """A gate, or one that says why it cannot be shown: the others, and steps that mend it, must stay at hand."""
    try:
        return gate(work)
    except CasacalError as error:
        missing = str(error)
    except Exception as error:
        missing = unforeseen(error)
    return {"state": AHEAD, "missing": missing, "facts": [], "notes": [], "touches": [], "fixed": True}


def files(work: Work) -> dict[str, Any]:
    """Files that a window may fetch, by the name in their address; some may not be there yet.

    A verification of an earlier calibration is none of them.
    """
    place = work.place
    found = {
        "plan.csv": place.plan_file,
        "sheet.html": place.folder / "sheet.html",
        "samples.csv": place.samples,
        "samples_check.csv": place.check,
        "report.html": place.fit / "report.html",
        "result.json": place.fit / "result.json",
        "parameters.csv": place.fit / "parameters.csv",
        "verified.html": place.folder / "verified.html",
    }
    with suppress(OSError):
        if found["verified.html"].stat().st_mtime_ns < found["result.json"].stat().st_mtime_ns:
            del found["verified.html"]
    return found


def _cell(work: Work) -> dict[str, Any]:
    problem, probe = work.source.problem, work.source.problem.instrument.probe
    still = cell_of(problem, work.source.cell)
    facts = [["Arm", f"{problem.robot.name}, {counted(len(problem.robot.axes), 'joint')}"]]
    units = [WRITTEN[kind][1] for kind in problem.layout().joints]
    limits = ", ".join(f"{low:.0f} to {high:.0f}" for low, high in (np.array(problem.robot.limits) * units).T)
    facts.append(["Joint limits", f"{limits} (degrees, mm)"])
    facts.append(["Instrument", f"{problem.names[0]}; read: {in_units(problem.layout()) or 'nothing, it touches'}"])
    tool = problem.instrument.unknowns.get("tool")
    if tool is not None and tool.nominal is not None and np.size(tool.nominal) == 3:
        facts.append(["Tip in the flange's frame", f"({', '.join(f'{each:g}' for each in tool.nominal)}) mm"])
    if probe is not None and probe.column is not None:
        low, high = readings_within(probe.travel)
        facts.append(["Travel of the dial", f"{low:g} to {high:g} mm"])
        way = "comes out" if probe.sign > 0 else "is pushed in"
        facts.append(["It reads more as the plunger", f"{way}; otherwise its sign in the problem file is wrong"])
    facts.append(["Table", f"z = {still.table:g} mm" if math.isfinite(still.table) else "not said"])
    for face in still.faces if isinstance(still, Cell) else ():
        (x, y, z), (u, v, w), (wide, deep) = face.centre, face.axes[0], face.size
        place = f"centre ({x:.0f}, {y:.0f}, {z:.0f}) mm, normal ({u:.2f}, {v:.2f}, {w:.2f}), {wide:.0f} x {deep:.0f} mm"
        facts.append([f"Face {face.label}", place])
    missing = f"{work.source.assumed}, and the fit relies on it" if work.source.assumed else ""
    if file := work.edited:
        missing = f"{file} was changed after this page was started. End casacal serve and start it again"
    return {"state": OPEN if missing else PASSED, "missing": missing, "facts": facts}


def _conventions(work: Work) -> dict[str, Any]:
    missing = (
        f"{ENOUGH_POSES} poses off the pendant tell whether its joints count as the problem says. An arm whose joints "
        "count the other way can fit every touch and be a mirror image"
    )
    confirmed = work.source.confirmed
    return {
        "state": PASSED if confirmed else OPEN,
        "missing": "" if confirmed else missing,
        "forms": list(ORIENTATIONS),
    }


def _plan(work: Work) -> dict[str, Any]:
    plan = None if work.recording is None else work.recording.session.plan
    missing = "The touches to make, and in which order: without a plan nobody knows which postures tell something"
    if plan is None:
        return {"state": OPEN, "missing": work.trouble or missing, "touches": [], "notes": [], "fixed": work.touched}
    touches = [
        {"number": k, "where": ", ".join(plan.samples.labels[name][k - 1] for name in plan.samples.labels)}
        | {"purpose": PURPOSES[purpose]}
        for k, purpose in enumerate(plan.purposes, 1)
    ]
    text = work.place.plan_file.read_text(encoding="utf-8", errors="replace")
    notes = [line.removeprefix("#").strip() for line in text.splitlines() if line.startswith("#")]
    fixed = work.place.plan is not None or len(work.recording.session) > 0  # type: ignore[union-attr]
    return {"state": PASSED, "missing": "", "touches": touches, "notes": notes, "fixed": fixed}


def _measure(work: Work) -> dict[str, Any]:
    recording = work.recording
    if recording is None:
        return {"state": AHEAD, "missing": work.trouble or "A plan: it says where to touch"}
    session = recording.session
    left = sum(touch.number is not None for touch in session.touches)
    planned = 0 if session.plan is None else len(session.plan)
    found: dict[str, Any] = {
        "made": len(session),
        "planned": planned,
        "doubled": recording.doubled is not None,
        "doubt": _doubt(session),
        "curve": [[count, error] for count, error in work.errors],
        "error": None if session.tip_error is None else figures(session.tip_error),
        "below": None if session.tip_error_below is None else figures(session.tip_error_below),
        "distrust": too_many_corrected(session),
        "tolerance": session.tolerance,
        "touches": [_made(session, k) for k in range(len(session))],
        "reads": list(session.problem.layout().columns),
        "gauge": work.place.gauge.name if work.line is not None else None,
        "asks": bool(work.place.gauge.asks) and work.line is not None,
        "controller": work.place.stands is not None,
        "help": help_words(session.problem, work.place.gauge),
        "skipped": sorted(session.skipped - {touch.number for touch in session.touches}),
    }
    found |= _next(work, recording)
    over = found["next"] is None and session.alarm is None
    found["ended"] = list(map(for_page, ended(session))) if over else []
    still = counted(max(planned - left - len(found["skipped"]), 0), "planned touch")
    missing = "" if over else f"{still}: what is not touched is not known"
    return found | {"state": PASSED if over else OPEN, "missing": missing}


def _doubt(session: Session) -> dict[str, Any] | None:
    """The doubt in words, each explanation with whether it can be accepted, and the touches that they are about."""
    alarm = session.alarm
    if alarm is None:
        return None
    what, *suspects, _ = doubt(session)
    can = [each.slip is not None for each in alarm.suspects]
    return {
        "what": what.removeprefix("warning: "),
        "suspect": session.shown(alarm.touch),
        "touches": list(dict.fromkeys(session.shown(k) for k in (alarm.raised_by, *(s.touch for s in alarm.suspects)))),
        "suspects": [{"words": words.strip(), "can": may} for words, may in zip(suspects, can, strict=True)],
    }


def _made(session: Session, k: int) -> dict[str, Any]:
    touch, layout = session.touches[k], session.problem.layout()
    read = [f"{touch.columns[name] * WRITTEN[kind][1]:.{SHOWN}f}" for name, kind in layout.columns.items()]
    state = "in doubt" if session.alarm is not None and session.alarm.touch == k else ""
    answered = "kept as it is" if touch.kept else "corrected" if touch.corrected else ""
    return {
        "number": session.shown(k),
        "where": ", ".join(touch.labels.values()),
        "read": " ".join(read),
        "purpose": PURPOSES[touch.purpose],
        "state": state or answered or ("waits" if k in session.waiting else ""),
    }


def _next(work: Work, recording: Recording) -> dict[str, Any]:
    """The posture to go to, and what is waited for."""
    session, layout = recording.session, recording.file.layout
    try:
        proposed = recording.proposed if session.alarm is None else None
    except SimulationError as error:
        return {"next": None, "waiting": str(error)}
    if proposed is None:
        return {"next": None, "waiting": ""}
    words = waiting(session, proposed, work.place.gauge, by_gauge=work.line is not None)
    beyond = None  # the posture in space, of a touch that no plan has
    if proposed.number is None:
        place = work.place
        (beyond,) = scene(session.problem, work.source.cell, place.clearance, rows_of([proposed]))["arms"]
    found = {
        "number": proposed.number,
        "where": ", ".join(proposed.labels[name] for name in layout.labels),
        "purpose": PURPOSES[proposed.purpose],
        "joints": joints_shown(proposed.joints, layout),
        "expected": to_expect(session, proposed),
        "warning": "" if recording.warning is None else sentence(recording.warning),
        "arm": beyond,
    }
    return {"next": found, "waiting": words}


def _decide(work: Work) -> dict[str, Any]:
    session = None if work.recording is None else work.recording.session
    made = () if session is None else [each for each in session.touches if each.purpose != CHECK]
    rows = rows_of(made) if made else None if session is None or session.plan is None else session.plan.samples
    least = 1 if rows is None else touches_needed(work.source.problem, rows)
    if len(made) < least:
        missing = f"Touches: {least} that are fitted, {len(made)} so far. The calibration is made from them"
        return {"state": AHEAD, "missing": missing}
    if work.arm is None or work.arm.found.verdict is None:
        return {"state": OPEN, "missing": "The calibration: it says what the touches tell, and whether to use it"}
    verdict = work.arm.found.verdict
    missing = "Touches were made after this calibration: calibrate again" if work.outdated else ""
    return {
        "state": OPEN if missing or verdict.level == "do not use" else PASSED,
        "missing": missing,
        "level": verdict.level,
        "words": verdict.words,
        "made_from": work.arm.found.data.sha256,
        "reasons": list(verdict.reasons),
        "mirror": work.arm.mirror_words,
    }


def _verify(work: Work) -> dict[str, Any]:
    if work.arm is None:
        return {"state": AHEAD, "missing": "A calibration: it is judged by touches that it has not seen"}
    if work.verified is None:
        missing = "The touches that were kept: whether the promise holds where nothing was fitted"
        if work.recording is not None and work.recording.session.skipped:
            missing += ". Touches were left out: ask for them again under Measure where too few are left"
        return {"state": OPEN, "missing": missing}
    found = work.verified
    missing = "" if found.passed else "Touches that show the arm within the tolerance: these leave it open or deny it"
    missing = missing if found.kept else "A promise that is kept: these touches are further off than it says"
    return {"state": PASSED if found.passed else OPEN, "missing": missing}


def _hand_over(work: Work) -> dict[str, Any]:
    if work.arm is None:
        return {"state": AHEAD, "missing": "A calibration: targets are corrected by it"}
    if work.arm.denial is not None:
        return {"state": AHEAD, "missing": f"A calibration that may be used. {work.arm.denial}"}
    verified = work.verified is not None and work.verified.passed
    missing = "" if verified else "A verification: targets can be corrected, and nobody has checked what they rely on"
    if work.outdated:
        missing = "A calibration of the touches as they are: some were made, or taken back, after this one"
    tip = work.arm.found.tip
    frames = [["tip", f"the tip of the tool that touched: error to expect {mm(tip.expected_mm)}"]]
    frames.append(["flange", f"the flange, for any other tool: error to expect {mm(tip.flange_expected_mm)}"])
    return {"state": OPEN, "missing": missing, "caution": work.arm.caution, "frames": frames}


GATES: Mapping[str, Callable[[Work], dict[str, Any]]] = {
    "cell": _cell,
    "conventions": _conventions,
    "plan": _plan,
    "measure": _measure,
    "decide": _decide,
    "verify": _verify,
    "hand_over": _hand_over,
}
