"""``python -m safedpa_services``: the command line, if the script ``safedpa`` is not on the path."""

from safedpa_services.command_line import main

if __name__ == "__main__":
    main()
