"""What figures show, as plain data: pure functions of arrays and tables. They import no backend."""
