/* A driver as an OSI traffic participant: a co-simulation unit of FMI 2.0
   (https://fmi-standard.org/downloads/) with the variables of OSMP, ASAM's OSI Sensor-Model
   Packaging (https://opensimulationinterface.github.io/osi-antora-generator/).

   driving.h has the driver, scene.h what they see. Here are the functions that FMI asks for.

   A message goes in and out as address (upper and lower half) and size of its bytes. One that comes
   out stays until the second step after it. */

#include <stdarg.h>

#include "driving.h"
#include "scene.h"

_Static_assert(SIGNALS == GAP, "a scene gives five signals");

/* Integers by value reference. */
enum {
    VIEW_LOW, VIEW_HIGH, VIEW_SIZE, MAP_LOW, MAP_HIGH, MAP_SIZE, VEHICLE, SEED, UPDATE_LOW,
    UPDATE_HIGH, UPDATE_SIZE, INTEGERS
};

enum { LONGEST_UPDATE = 512 }; /* bytes: more than all its fields take */

struct callbacks { /* fmi2CallbackFunctions */
    void (*log)(void *environment, const char *name, int status, const char *category, const char *message, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *environment, int status);
    void *environment;
};

/* All that changes while a unit is simulated, so that a state is a copy of it. */
struct memory {
    struct state driver;
    struct seen seen, leader_seen;
    uint8_t update[2][LONGEST_UPDATE]; /* of the last step and of the one before */
    int32_t size[2];
    int shown; /* which of them is the last step's */
};

struct unit {
    struct memory memory;
    int32_t input[SEED]; /* all integers below the seed */
    osi3_GroundTruth map; /* of OSMPGroundTruthInit */
    char name[64];
    struct callbacks callbacks;
};

static status say(struct unit *unit, status status, const char *format, ...) {
    char message[512];
    va_list values;
    va_start(values, format);
    vsnprintf(message, sizeof message, format, values);
    va_end(values);
    const char *category = status == DISCARD ? "logStatusDiscard" : "logStatusError";
    /* The message is a format for printf, which not every importer applies; none has a '%'. */
    if (unit->callbacks.log)
        unit->callbacks.log(unit->callbacks.environment, unit->name, status, category, message);
    return status;
}

static void clear(struct unit *unit) {
    pb_release(osi3_GroundTruth_fields, &unit->map);
    memset(&unit->map, 0, sizeof unit->map);
    memset(&unit->memory, 0, sizeof unit->memory);
    memset(unit->input, 0, sizeof unit->input);
    unit->input[VEHICLE] = -1;
    begin(&unit->memory.driver);
}

/* --- Messages -------------------------------------------------------------------------------- */

/* Returns the bytes at an address in two halves; NULL where there is none. */
static const pb_byte_t *bytes_at(const int32_t *halves) {
    uint64_t address = (uint64_t)(uint32_t)halves[1] << 32 | (uint32_t)halves[0];
    return (const pb_byte_t *)(uintptr_t)address;
}

/* Reads a message of which address and size are given. */
static status read_message(
    struct unit *unit, const int32_t *place, const pb_msgdesc_t *kind, void *message, const char *name) {
    pb_istream_t stream = pb_istream_from_buffer(bytes_at(place), (size_t)place[2]);
    if (pb_decode(&stream, kind, message)) return OK;
    return say(unit, ERROR, "the %d bytes are no osi3::%s (%s); is the message whole, and its address right?",
               place[2], name, PB_GET_ERROR(&stream));
}

static bool is_given(const int32_t *place) { return place[2] > 0 && bytes_at(place); }

/* Writes what a step came to as the next osi3::TrafficUpdate. */
static status write_update(struct unit *unit, struct memory *next, osi3_MovingObject *object, double time) {
    osi3_TrafficUpdate update = osi3_TrafficUpdate_init_zero;
    update.has_version = update.has_timestamp = true;
    update.version = (osi3_InterfaceVersion){true, OSI_MAJOR, true, OSI_MINOR, true, OSI_PATCH};
    int64_t nanoseconds = llround(1e9 * time);
    int64_t seconds = nanoseconds / 1000000000;
    update.timestamp = (osi3_Timestamp){true, seconds, true, (uint32_t)(nanoseconds - 1000000000 * seconds)};
    update.update_count = 1;
    update.update = object;
    next->shown = 1 - next->shown;
    pb_ostream_t stream = pb_ostream_from_buffer(next->update[next->shown], LONGEST_UPDATE);
    if (!pb_encode(&stream, osi3_TrafficUpdate_fields, &update))
        return say(unit, ERROR, "the osi3::TrafficUpdate was not written (%s)", PB_GET_ERROR(&stream));
    next->size[next->shown] = (int32_t)stream.bytes_written;
    return OK;
}

/* --- Instances ------------------------------------------------------------------------------- */

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT status fmi2SetDebugLogging(void *instance, int on, size_t count, const char *const categories[]) {
    (void)instance, (void)on, (void)count, (void)categories;
    return OK;
}

EXPORT void *fmi2Instantiate(
    const char *name, int type, const char *token, const char *resources,
    const struct callbacks *callbacks, int visible, int logging) {
    (void)resources, (void)visible, (void)logging;
    struct unit *unit = calloc(1, sizeof *unit);
    if (!unit) return NULL;
    unit->callbacks = *callbacks;
    snprintf(unit->name, sizeof unit->name, "%s", name ? name : "");
    if (type != 1 || !token || strcmp(token, TOKEN)) { /* fmi2CoSimulation */
        say(unit, ERROR, type == 1 ? "the GUID is another unit's" : "the unit is for co-simulation alone");
        free(unit);
        return NULL;
    }
    clear(unit);
    return unit;
}

EXPORT void fmi2FreeInstance(void *instance) {
    if (instance) clear(instance);
    free(instance);
}

EXPORT status fmi2SetupExperiment(
    void *instance, int has_tolerance, double tolerance, double start, int has_stop, double stop) {
    (void)instance, (void)has_tolerance, (void)tolerance, (void)start, (void)has_stop, (void)stop;
    return OK;
}

EXPORT status fmi2EnterInitializationMode(void *instance) {
    (void)instance;
    return OK;
}

EXPORT status fmi2ExitInitializationMode(void *instance) {
    struct unit *unit = instance;
    start(&unit->memory.driver);
    if (!is_given(&unit->input[MAP_LOW])) return OK;
    return read_message(unit, &unit->input[MAP_LOW], osi3_GroundTruth_fields, &unit->map, "GroundTruth");
}

EXPORT status fmi2Terminate(void *instance) {
    (void)instance;
    return OK;
}

EXPORT status fmi2Reset(void *instance) {
    clear(instance);
    return OK;
}

/* --- Variables ------------------------------------------------------------------------------- */

EXPORT status fmi2GetInteger(void *instance, const unsigned references[], size_t count, int values[]) {
    struct unit *unit = instance;
    const struct memory *memory = &unit->memory;
    int32_t size = memory->size[memory->shown];
    uint64_t address = size > 0 ? (uint64_t)(uintptr_t)memory->update[memory->shown] : 0;
    for (size_t k = 0; k < count; k++) {
        unsigned reference = references[k];
        if (reference >= INTEGERS) return say(unit, ERROR, "there is no integer with reference %u", reference);
        if (reference < SEED) values[k] = unit->input[reference];
        else if (reference == SEED) values[k] = memory->driver.seed;
        else if (reference == UPDATE_LOW) values[k] = (int32_t)(uint32_t)address;
        else if (reference == UPDATE_HIGH) values[k] = (int32_t)(uint32_t)(address >> 32);
        else values[k] = size;
    }
    return OK;
}

EXPORT status fmi2SetInteger(void *instance, const unsigned references[], size_t count, const int values[]) {
    struct unit *unit = instance;
    for (size_t k = 0; k < count; k++) {
        if (references[k] > SEED) return say(unit, ERROR, "reference %u is no input", references[k]);
        if (references[k] == SEED) unit->memory.driver.seed = values[k];
        else unit->input[references[k]] = values[k];
    }
    return OK;
}

/* --- Steps ----------------------------------------------------------------------------------- */

/* Lets the driver go on from a scene, by a step of any length. */
static status drive(struct unit *unit, const osi3_SensorView *view, double point, double length) {
    struct memory *next = malloc(sizeof *next);
    if (!next) return say(unit, ERROR, "there is no memory for a step");
    *next = unit->memory;
    const osi3_GroundTruth *truth = &view->global_ground_truth;
    const osi3_GroundTruth *map = truth->lane_count > 0 ? truth : &unit->map;
    struct scene scene = {.seen = next->seen, .leader_seen = next->leader_seen};
    char problem[256] = "the step is discarded, as a number is none";
    status done = look(&scene, view, map, unit->input[VEHICLE], point, problem);
    if (done == OK) {
        double *value = next->driver.value;
        value[EGO_SPEED] = scene.speed;
        value[EGO_ACCELERATION] = scene.acceleration;
        value[LEADER_SPEED] = scene.leader_speed;
        value[LEADER_ACCELERATION] = scene.leader_acceleration;
        value[GAP] = scene.gap;
        next->seen = scene.seen;
        next->leader_seen = scene.leader_seen;
        done = advance(&next->driver, length);
    }
    if (done != OK) say(unit, done, "%s", problem);
    if (done == OK) {
        const double *value = next->driver.value;
        osi3_MovingObject object =
            moved(&scene, next->driver.driven, value[NEXT_SPEED], value[ACCELERATION], length);
        done = write_update(unit, next, &object, scene.time + length);
    }
    if (done == OK) unit->memory = *next;
    leave(&scene);
    free(next);
    return done;
}

EXPORT status fmi2DoStep(void *instance, double point, double length, int no_set_before) {
    struct unit *unit = instance;
    (void)no_set_before;
    if (!(length > SHORTEST))
        return say(unit, ERROR, "a step of %g s does not go on; give one above 0", length);
    if (!is_given(&unit->input[VIEW_LOW])) { /* as in the first step of a loop: nothing to go by */
        unit->memory.shown = 1 - unit->memory.shown;
        unit->memory.size[unit->memory.shown] = 0;
        return OK;
    }
    osi3_SensorView view = osi3_SensorView_init_zero;
    status done = read_message(unit, &unit->input[VIEW_LOW], osi3_SensorView_fields, &view, "SensorView");
    if (done == OK) done = drive(unit, &view, point, length);
    pb_release(osi3_SensorView_fields, &view);
    return done;
}

/* --- States ---------------------------------------------------------------------------------- */

EXPORT status fmi2GetFMUstate(void *instance, void **state) {
    if (!*state && !(*state = malloc(sizeof(struct memory)))) return ERROR;
    memcpy(*state, &((struct unit *)instance)->memory, sizeof(struct memory));
    return OK;
}

EXPORT status fmi2SetFMUstate(void *instance, void *state) {
    memcpy(&((struct unit *)instance)->memory, state, sizeof(struct memory));
    return OK;
}

EXPORT status fmi2FreeFMUstate(void *instance, void **state) {
    (void)instance;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT status fmi2SerializedFMUstateSize(void *instance, void *state, size_t *size) {
    (void)instance, (void)state;
    *size = sizeof(struct memory);
    return OK;
}

EXPORT status fmi2SerializeFMUstate(void *instance, void *state, char bytes[], size_t size) {
    (void)instance;
    if (size < sizeof(struct memory)) return ERROR;
    memcpy(bytes, state, sizeof(struct memory));
    return OK;
}

EXPORT status fmi2DeSerializeFMUstate(void *instance, const char bytes[], size_t size, void **state) {
    (void)instance;
    if (size != sizeof(struct memory)) return ERROR;
    if (!*state && !(*state = malloc(sizeof(struct memory)))) return ERROR;
    memcpy(*state, bytes, sizeof(struct memory));
    return OK;
}

/* --- What a unit of this kind has not, but must export ---------------------------------------- */

#define REFUSED(name) EXPORT status name() { return ERROR; }

REFUSED(fmi2GetReal)
REFUSED(fmi2GetBoolean)
REFUSED(fmi2GetString)
REFUSED(fmi2SetReal)
REFUSED(fmi2SetBoolean)
REFUSED(fmi2SetString)
REFUSED(fmi2GetDirectionalDerivative)
REFUSED(fmi2SetRealInputDerivatives)
REFUSED(fmi2GetRealOutputDerivatives)
REFUSED(fmi2CancelStep)
REFUSED(fmi2GetStatus)
REFUSED(fmi2GetRealStatus)
REFUSED(fmi2GetIntegerStatus)
REFUSED(fmi2GetBooleanStatus)
REFUSED(fmi2GetStringStatus)
