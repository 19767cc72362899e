"""``python -m colourreg_rs`` is the command ``colourreg``."""

from .cli import main

if __name__ == "__main__":
    main()
