/* What every unit of a driver shares, whichever interface it has: what a driver remembers, and
   steps of other lengths than the driver's.

   driver.h, made from the driver's ONNX graph, has the step of one driver: DT, SIGNALS, NOISE,
   TOKEN, `struct remembered` and `driver_step`. */

#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#include "driver.h"

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } status; /* fmi3Status, fmi2Status */

/* Places of the numbers that a driver takes and gives: the time, SIGNALS inputs, two outputs. */
enum { TIME = 0, NEXT_SPEED = SIGNALS + 1, ACCELERATION };
/* Among the inputs: the first five signals of every driver. */
enum { EGO_SPEED = 1, EGO_ACCELERATION, LEADER_SPEED, LEADER_ACCELERATION, GAP };

#define SHORTEST 1e-9 /* s: what is left of a step below it is rounding */

/* All that changes while a unit is simulated, so that a state is a copy of it. */
struct state {
    double value[ACCELERATION + 1];
    int32_t seed;
    uint64_t random;
    double due;  /* s until the driver decides again */
    double held; /* m/s2: what it has decided */
    double driven; /* m, in the last communication step */
    struct remembered remembered;
};

/* Sets inputs to what the model description says. */
static void begin(struct state *state) {
    memset(state, 0, sizeof *state);
    state->value[EGO_SPEED] = state->value[LEADER_SPEED] = 10.0;
    state->value[GAP] = 30.0;
    state->value[NEXT_SPEED] = state->value[EGO_SPEED];
}

/* Begins a driver, whose randomness the seed determines; until the first step the speed stays. */
static void start(struct state *state) {
    state->random = (uint64_t)(uint32_t)state->seed;
    state->value[NEXT_SPEED] = state->value[EGO_SPEED];
}

/* SplitMix64 (Steele, Lea and Flood 2014, Fast splittable pseudorandom number generators). */
static uint64_t random_bits(uint64_t *random) {
    uint64_t bits = (*random += 0x9E3779B97F4A7C15u);
    bits = (bits ^ (bits >> 30)) * 0xBF58476D1CE4E5B9u;
    bits = (bits ^ (bits >> 27)) * 0x94D049BB133111EBu;
    return bits ^ (bits >> 31);
}

/* A standard normal number (Box and Muller 1958). */
static double normal(uint64_t *random) {
    double first = (double)((random_bits(random) >> 11) + 1) * 0x1.0p-53; /* (0, 1] */
    double second = (double)(random_bits(random) >> 11) * 0x1.0p-53;
    return sqrt(-2.0 * log(first)) * cos(6.283185307179586 * second);
}

/* Lets the driver decide; NaN where an input is not a number. */
static double decide(struct state *state, const double signal[SIGNALS]) {
    struct remembered after;
    double noise[NOISE + 1], speed;
    uint64_t random = state->random;
    for (int k = 0; k < NOISE; k++) noise[k] = normal(&random);
    driver_step(signal, &state->remembered, noise, &speed, &after);
    if (isnan(speed)) return NAN;
    state->random = random;
    state->remembered = after;
    return speed;
}

/* Simulates a communication step of any length. The driver decides every DT and holds its
   acceleration in between. Within a step that is longer, the vehicle ahead keeps the acceleration
   that it has at the begin. Discards the step where an input is not a number. */
static status advance(struct state *state, double length) {
    struct state next = *state;
    double signal[SIGNALS], left = length;
    memcpy(signal, next.value + 1, sizeof signal);
    double *speed = &signal[EGO_SPEED - 1], *ahead = &signal[LEADER_SPEED - 1];
    double *gap = &signal[GAP - 1];
    next.driven = 0.0;
    while (left > SHORTEST) {
        if (next.due <= SHORTEST) {
            double decided = decide(&next, signal);
            if (isnan(decided)) return DISCARD;
            next.held = (decided - *speed) / DT;
            next.due = DT;
        }
        double part = fmin(next.due, left);
        /* The models integrate by forward Euler: vehicles move by their new speeds. */
        *speed = fmax(0.0, *speed + next.held * part);
        *ahead = fmax(0.0, *ahead + signal[LEADER_ACCELERATION - 1] * part);
        *gap += (*ahead - *speed) * part;
        next.driven += *speed * part;
        signal[EGO_ACCELERATION - 1] = next.held;
        next.due -= part;
        left -= part;
    }
    next.value[NEXT_SPEED] = *speed;
    next.value[ACCELERATION] = (*speed - next.value[EGO_SPEED]) / length;
    *state = next;
    return OK;
}
