"""``python -m safedpa_services``: the command line, if the script ``safedpa`` is not on the path."""

import os
import sys

if not sys.flags.safe_path and sys.path[:1] in ([""], [os.getcwd()]):
    del sys.path[0]  # ``-m`` puts the working directory first: a file there would be imported in place of a library

from safedpa_services.command_line import main

if __name__ == "__main__":
    main()
