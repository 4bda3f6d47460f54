"""Reports for people: texts, tables and figures, in centimetres."""
