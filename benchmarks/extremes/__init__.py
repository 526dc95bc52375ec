"""Rows of the stability table: each module takes the tracer to one kind of extreme, beside a truth."""
