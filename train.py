"""Trains one model, or with -m a sweep of them: `python train.py activation=hosc encoding=fourier`."""

import gc

if __name__ == "__main__":
    gc.disable()  # what imports make stays: looking it over for garbage is a fifth of a start
    from sdfhub.tasks.train import main

    gc.freeze()
    gc.enable()
    main()
