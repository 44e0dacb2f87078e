"""``python -m capsense``, the same as the ``capsense`` command."""

import sys

from capsense.cli.main import main

sys.exit(main())
