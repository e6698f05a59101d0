"""Many trainings from one command: names of folders, cells of a table, searches, the report at the end."""
