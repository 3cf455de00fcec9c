"""The Intelligent Driver Model (`idm`) and its improved acceleration function (`iidm`), for cfx."""
