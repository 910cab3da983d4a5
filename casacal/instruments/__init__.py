"""Instruments: how rows are measured. Each module is imported when something in it is asked for."""

from casacal.instruments.description import Sight as Sight
from casacal.instruments.description import Suspect as Suspect
from casacal.instruments.description import Words as Words
from casacal.instruments.instrument import Instrument as Instrument
