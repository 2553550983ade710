"""``python -m stereoservo.cli``: the command line ``stereoservo``."""

from stereoservo.cli.main import main

main()
