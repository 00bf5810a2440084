"""`python -m vjm` is the command `vjm`."""

import sys

from vjm.cli import main

sys.exit(main())
