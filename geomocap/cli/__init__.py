"""The command line: the one place that ties geomocap, data_tools and viz together."""
