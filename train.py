"""Trains one model, or with -m a sweep of them: `python train.py activation=hosc encoding=fourier`."""

import sys

from sdfhub.tasks.command import main

if __name__ == "__main__":
    sys.argv.insert(1, "train")
    main()
