"""Results as text, tables, pictures, a page and a folder of files."""
