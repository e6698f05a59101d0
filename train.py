"""Trains one model, or with -m a sweep of them: `python train.py activation=hosc encoding=fourier`."""

from sdfhub.tasks.train import main

if __name__ == "__main__":
    main()
