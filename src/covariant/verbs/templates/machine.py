def friction(q, v, viscous, coulomb):
    """The force of friction (n,), which opposes the motion."""
    return -viscous * v - coulomb * jnp.arctan(100.0 * v)


def drive(t, q, u):
    """The force of the inputs (n,), here on xPUSHESx."""
    return jnp.zeros(xPOSITIONCOUNTx, u.dtype).at[jnp.array(xDRIVENx, int)].set(u)


def machine(energy, potential, viscous, coulomb):
    """The machine of these energies, with the positions of the log."""
    return Lagrangian(
        energy,
        potential,
        force=drive,
        dissipation=Parametric(friction, viscous=jnp.asarray(viscous), coulomb=jnp.asarray(coulomb)),
        circles=xCIRCLESx,  # positions that are angles on a full circle
        coordinates=(xPOSITIONSx),
        units=(xUNITSx),
        inputs=xINPUTSx,
    )
