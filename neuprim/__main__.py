"""``python -m neuprim``, the same as the ``neuprim`` command."""

import sys

from neuprim.cli import main

if __name__ == "__main__":
    sys.exit(main())
