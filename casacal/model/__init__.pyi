"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.model.carriers import carried as carried
from casacal.model.carriers import facing as facing
from casacal.model.carriers import rail as rail
from casacal.model.carriers import turntable as turntable
from casacal.model.closed_chains import passive as passive
from casacal.model.constraint import Constraint as Constraint
from casacal.model.constraint import between as between
from casacal.model.constraint import certified as certified
from casacal.model.constraint import equal as equal
from casacal.model.instrument import Probe as Probe
from casacal.model.instrument import ResidualBlock as ResidualBlock
from casacal.model.instrument import Sight as Sight
from casacal.model.instrument import Suspect as Suspect
from casacal.model.instrument import Trusted as Trusted
from casacal.model.instrument import Words as Words
from casacal.model.problem_file import ProblemFile as ProblemFile
from casacal.model.trace import Symbols as Symbols
from casacal.model.unknown import Unknown as Unknown
