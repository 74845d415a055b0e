"""What all launchers share on the command line: options, errors, signals, progress and XLA's flags."""
