"""Instance × regime × method to rows: results table, tasks, worker processes, cluster."""
