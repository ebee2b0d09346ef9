"""The one writer of reports, for benches, judgements, sweeps and chapter 4: data, tables, figures, page."""
