"""What all launchers share on the command line: options, errors, signals, tables and XLA's flags."""
