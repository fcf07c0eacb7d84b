"""What a results folder holds: every path, tables and archives."""
