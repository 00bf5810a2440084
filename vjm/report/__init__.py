"""What vjm found, as pictures, tables, a page and a folder of files."""
