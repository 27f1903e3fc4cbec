"""`python -m compgs`: the same as `compgs`."""

import sys

from compgs.cli.main import main

sys.exit(main())
