"""`python -m surecut.estimator` is `surecut`."""

from .cli import main

if __name__ == "__main__":
    main()
