"""From the folders of a sweep to tables, claims and one page. Plain data in, plain files out."""
