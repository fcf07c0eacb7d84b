"""What a benchmark does with methods: run, time, tabulate, report."""
