"""From stored data alone: statistics, tables, figures, pages, and their check."""
