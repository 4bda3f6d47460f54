"""What people read: tables and figures, in centimetres."""
