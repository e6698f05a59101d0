"""Where shapes come from and how they become samples."""
