"""Before a diagnosis: which effects the data could show. Read ``rehearsal`` first."""
