"""Run the command line: ``python -m photutils_mgauss``."""
import sys

from photutils_mgauss.cli import main

sys.exit(main())
