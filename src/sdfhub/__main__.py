"""`python -m sdfhub TASK ...`, the same as the console command `sdfhub`."""

from sdfhub.tasks.command import main

main()
