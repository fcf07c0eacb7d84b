"""The committed reference run: the paper's tables follow from its rows, kept schedules score so."""
