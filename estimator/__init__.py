"""The graph, its solvers, the drivers, the command line and the report."""
