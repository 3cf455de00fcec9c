"""The improved acceleration function of the Intelligent Driver Model (`iidm`), for cfx."""
