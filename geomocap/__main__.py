"""`python -m geomocap` is the command `geomocap`."""

from geomocap.cli import main

main()
