"""`python -m casacal`: the command line without an installed script."""

import sys

from casacal.cli.main import main

sys.exit(main())
