"""Damaged programs: each is read or refused in a sentence, by line; nothing but digits of its targets ever changes."""

import random
import re

import pytest
from fuzz import mutated
from written_programs import ENDINGS, arm_of, changes_of, written

from casacal.errors import CasacalError
from casacal.programs import compensate_program, read_program
from casacal.programs.read import read_again

TOKENS = {
    language: tuple(words.encode().split(b"~"))
    for language, words in {
        "rapid": 'MoveL ~[~]~;~"~!~:=~\\WObj:=~Offs(~robtarget p10~PDispOn ~9E9~tGrip0~p20',
        "krl": 'LIN ~{~}~,~XP1~=~"~;~$BASE=~$TOOL~:~FDAT_ACT=~S 2~A1 ~BASE_DATA[~WITH $TOOL = STOOL2(FP3)',
        "urscript": 'movel(~p[~]~)~#~"~=~set_tcp(~d2r(~pose_trans(~get_inverse_kin(~,~w1~movec(',
        "fanuc": "P[~]~{~};~GP1:~CONFIG : '~L ~:~Offset,PR[1]~X =~/POS~/MN~ deg~UF : 1, UT : 1,~J1=",
        "yaskawa": "MOVL ~C00001~=~,~///POSTYPE USER~///RCONF ~//INST~///PULSE~'~SFTON P001~\r\n~///USER 1",
    }.items()
}
BOTH = (b"\r\n", b"\xff", b"\xc3\xa4", b"-", b".", b"1e400", b"99999999999", b"(((((((((((((((", b"[[[[[[[[[[[[[[[[")
MARKED = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def one(language, number, folder, arm=None):
    """Read a damaged program, move its numbers, and look at what changed; 1 where it was understood."""
    rng = random.Random(f"{language} {number}")
    made = written(language, moves=12, seed=number % 5, digits=rng.choice((2, 4)), end=rng.choice(("\n", "\r\n")))
    for ending, text in made.files.items():
        data = text.encode()
        if len(made.files) == 1 or rng.random() < 0.6:
            data = mutated(data, rng, TOKENS[language] + BOTH)
        (folder / f"cell{ending}").write_bytes(data)
    try:
        program = read_program(folder / f"cell{ENDINGS[language]}", **made.options)
    except CasacalError as error:
        return str(error).count("\n")
    for puzzle in program.puzzles:
        lines = len(re.split(r"\r\n|\n|\r", program.texts[puzzle.file]))
        assert 1 <= puzzle.line <= lines
        assert puzzle.what
    spans = {(n.file, n.start, n.end) for target in program.targets for n in target.numbers}
    values = {n: n.value + rng.choice((0.25, -3.5, 0.0)) for target in program.targets for n in target.numbers}
    texts = program.with_numbers(values)
    for k, (before, after) in enumerate(zip(program.texts, texts, strict=True)):
        assert outside(before, [span[1:] for span in spans if span[0] == k]) == outside_again(
            program, k, before, after, values
        )
        assert MARKED.sub(b"#", after.encode("latin-1")) == MARKED.sub(b"#", before.encode("latin-1"))
    if arm is not None and program.targets:
        try:
            done = compensate_program(arm, program, skip_unknown=True)
        except CasacalError:
            return 0
        assert [t.name for t in read_again(program, done.texts).targets] == [t.name for t in program.targets]
        for before, after in zip(program.texts, done.texts, strict=True):
            assert MARKED.sub(b"#", after.encode("latin-1")) == MARKED.sub(b"#", before.encode("latin-1"))
    return int(bool(program.moves))


def outside(text, spans):
    """Text without some spans."""
    kept, at = [], 0
    for start, end in sorted(spans):
        kept.append(text[at:start])
        at = end
    return [*kept, text[at:]]


def outside_again(program, k, before, after, values):
    """The new text without the digits that stand where the old ones did."""
    kept, at, grown = [], 0, 0
    for number in sorted((n for n in values if n.file == k), key=lambda n: n.start):
        new = number.written(before[number.start : number.end], values[number])
        kept.append(after[at + grown : number.start + grown] if at else after[: number.start])
        assert after[number.start + grown :].startswith(new)
        grown += len(new) - (number.end - number.start)
        at = number.end
    return [*kept, after[at + grown :]]


@pytest.mark.parametrize("language", list(ENDINGS))
def test_damaged_programs_are_read_or_refused(language, tmp_path):
    understood = sum(one(language, number, tmp_path) for number in range(60))
    assert understood > 20


@pytest.mark.parametrize("language", list(ENDINGS))
def test_damaged_programs_are_corrected_as_far_as_they_are_understood(language, tmp_path):
    arm = arm_of(language, changes_of(2))
    assert sum(one(language, 1000 + number, tmp_path, arm) for number in range(3)) >= 0


@pytest.mark.long
@pytest.mark.parametrize("language", list(ENDINGS))
def test_2000_damaged_programs(language, tmp_path):
    arm = arm_of(language, changes_of(2))
    for number in range(400):
        one(language, 5000 + number, tmp_path, arm if number % 100 == 0 else None)
