/* What a driver sees in a scene of OSI (https://www.asam.net/standards/detail/osi/), and where
   their vehicle is after a step.

   Positions are centres of bounding boxes, in the plane of the scene's global frame; heights stay
   as the scene gives them. A place on a path is how far along it is, and how far to the left. */

#define OSI_MAJOR 3
#define OSI_MINOR 8
#define OSI_PATCH 0

#define PB_ENABLE_MALLOC 1 /* lists of OSI have no greatest length */
#define PB_FIELD_32BIT 1
#include "pb_common.c"
#include "pb_decode.c"
#include "pb_encode.c"
#include "osi.pb.c"

#define LOOK_AHEAD 500.0 /* m: how far lanes are followed */
#define SAME_POINT 1.0   /* m: within it one lane goes on where another ends */

enum { MOST_LANES = 64 };

struct point {
    double x, y;
};

/* Where a vehicle goes: along centerlines, straight on behind their end; or straight. */
struct path {
    struct point *points;
    size_t count;
    double length;             /* m, of the centerlines; 0 where the path is straight */
    uint64_t lane[MOST_LANES]; /* whoever is in one of these is in the way */
    size_t lanes;
};

struct place {
    double along, aside, heading; /* m, m, rad: of the path there */
};

/* Speed of a vehicle in the last scene, of which its acceleration is made where none is given. */
struct seen {
    bool any;
    uint64_t id;
    double time, speed;
};

struct scene {
    const osi3_MovingObject *ego;
    struct path path;
    struct place place; /* of the ego vehicle */
    double time;
    double speed, acceleration;             /* m/s, m/s2 along the path */
    double leader_speed, leader_acceleration, gap; /* gap: infinite where nobody is ahead */
    struct seen seen, leader_seen;
};

/* --- Paths ----------------------------------------------------------------------------------- */

static double between(struct point a, struct point b) { return hypot(b.x - a.x, b.y - a.y); }

/* An angle from -pi to pi. */
static double turned(double angle) { return remainder(angle, 6.283185307179586); }

/* Appends a point, if it is another than the last. Returns whether there was memory. */
static bool append(struct path *path, struct point point) {
    if (path->count > 0 && between(path->points[path->count - 1], point) < 1e-6) return true;
    if ((path->count & (path->count + 1)) == 0) { /* full at 0, 1, 3, 7, ...: doubles */
        size_t room = 2 * path->count + 1;
        struct point *points = realloc(path->points, room * sizeof *points);
        if (!points) return false;
        path->points = points;
    }
    if (path->count > 0) path->length += between(path->points[path->count - 1], point);
    path->points[path->count++] = point;
    return true;
}

/* Returns where a point is on a path: at the nearest segment, of which the first goes on backwards
   and the last forwards. */
static struct place place_of(const struct path *path, struct point point) {
    struct place nearest = {0.0, 0.0, 0.0};
    double least = INFINITY, start = 0.0;
    for (size_t k = 0; k + 1 < path->count; k++) {
        struct point a = path->points[k], b = path->points[k + 1];
        double length = between(a, b), x = (b.x - a.x) / length, y = (b.y - a.y) / length;
        double along = (point.x - a.x) * x + (point.y - a.y) * y;
        double aside = (point.y - a.y) * x - (point.x - a.x) * y;
        double foot = along;
        if (k > 0) foot = fmax(foot, 0.0);
        if (k + 2 < path->count) foot = fmin(foot, length);
        double distance = hypot(along - foot, aside);
        if (distance < least) {
            least = distance;
            nearest = (struct place){start + foot, aside, atan2(y, x)};
        }
        start += length;
    }
    return nearest;
}

/* Returns the point at a place, and sets the place's heading. */
static struct point point_at(const struct path *path, struct place *place) {
    double start = 0.0;
    size_t k = 0;
    struct point a = path->points[0], b = path->points[1];
    while (k + 2 < path->count && place->along > start + between(a, b)) {
        start += between(a, b);
        k++;
        a = path->points[k];
        b = path->points[k + 1];
    }
    double length = between(a, b), x = (b.x - a.x) / length, y = (b.y - a.y) / length;
    double along = place->along - start;
    place->heading = atan2(y, x);
    return (struct point){a.x + along * x - place->aside * y, a.y + along * y + place->aside * x};
}

/* --- Lanes ----------------------------------------------------------------------------------- */

static bool has_centerline(const osi3_Lane *lane) { return lane->classification.centerline_count > 1; }

static struct point point_of(const osi3_Vector3d *vector) { return (struct point){vector->x, vector->y}; }

static const osi3_Lane *lane_of(const osi3_GroundTruth *map, uint64_t id) {
    for (size_t k = 0; k < map->lane_count; k++)
        if (map->lane[k].id.value == id) return &map->lane[k];
    return NULL;
}

static bool is_on(const struct path *path, uint64_t lane) {
    for (size_t k = 0; k < path->lanes; k++)
        if (path->lane[k] == lane) return true;
    return false;
}

static void add_lane(struct path *path, uint64_t lane) {
    if (path->lanes < MOST_LANES && !is_on(path, lane)) path->lane[path->lanes++] = lane;
}

/* Calls of an object's lanes by number: in their place, and in OSI's earlier one. */
static size_t lanes_of(const osi3_MovingObject *object) {
    return object->moving_object_classification.assigned_lane_id_count + object->assigned_lane_id_count;
}

static uint64_t assigned_lane(const osi3_MovingObject *object, size_t number) {
    size_t first = object->moving_object_classification.assigned_lane_id_count;
    if (number < first) return object->moving_object_classification.assigned_lane_id[number].value;
    return object->assigned_lane_id[number - first].value;
}

static bool append_lane(struct path *path, const osi3_Lane *lane, bool backwards) {
    const osi3_Lane_Classification *about = &lane->classification;
    add_lane(path, lane->id.value);
    for (size_t k = 0; k < about->centerline_count; k++) {
        size_t number = backwards ? about->centerline_count - 1 - k : k;
        if (!append(path, point_of(&about->centerline[number]))) return false;
    }
    return true;
}

/* Returns the lane that goes on straightest where a path ends; NULL where none does.

   Simulators differ in what comes before and after on lanes against the road's direction, so both
   ends of all lanes that a lane is paired with are tried. */
static const osi3_Lane *next_lane(
    const struct path *path, const osi3_GroundTruth *map, const osi3_Lane *lane, bool *backwards) {
    struct point end = path->points[path->count - 1], before = path->points[path->count - 2];
    double heading = atan2(end.y - before.y, end.x - before.x), least = 1.5707963267948966;
    const osi3_Lane *straightest = NULL;
    for (size_t k = 0; k < 2 * lane->classification.lane_pairing_count; k++) {
        const osi3_Lane_Classification_LanePairing *pair = &lane->classification.lane_pairing[k / 2];
        uint64_t id = k % 2 ? pair->antecessor_lane_id.value : pair->successor_lane_id.value;
        const osi3_Lane *other = lane_of(map, id);
        if (!other || !has_centerline(other) || is_on(path, id)) continue;
        const osi3_Vector3d *line = other->classification.centerline;
        size_t last = other->classification.centerline_count - 1;
        for (int side = 0; side < 2; side++) {
            struct point a = point_of(&line[side ? last : 0]);
            struct point b = point_of(&line[side ? last - 1 : 1]);
            double turn = fabs(turned(atan2(b.y - a.y, b.x - a.x) - heading));
            if (between(end, a) < SAME_POINT && turn < least) {
                least = turn;
                straightest = other;
                *backwards = side;
            }
        }
    }
    return straightest;
}

/* Makes a vehicle's path: along the centerline of its lane, in the direction that it heads, and of
   the lanes that go on from there; straight on where its lane has none. Returns whether there was
   memory. */
static bool find_path(struct path *path, const osi3_GroundTruth *map, const osi3_MovingObject *ego) {
    struct point position = point_of(&ego->base.position);
    double yaw = ego->base.orientation.yaw;
    const osi3_Lane *lane = NULL;
    for (size_t k = 0; k < lanes_of(ego); k++) {
        const osi3_Lane *assigned = lane_of(map, assigned_lane(ego, k));
        /* A lane without centerline is an intersection: who is there may cross it. */
        if (!assigned || has_centerline(assigned)) add_lane(path, assigned_lane(ego, k));
        if (!lane && assigned && has_centerline(assigned)) lane = assigned;
    }
    if (lane) {
        if (!append_lane(path, lane, false)) return false;
        bool backwards = path->count > 1 && cos(place_of(path, position).heading - yaw) < 0.0;
        if (backwards) {
            path->count = 0;
            path->length = 0.0;
            if (!append_lane(path, lane, true)) return false;
        }
    }
    if (path->count > 1) {
        double until = place_of(path, position).along + LOOK_AHEAD;
        while (lane && path->length < until && path->lanes < MOST_LANES) {
            bool backwards = false;
            lane = next_lane(path, map, lane, &backwards);
            if (lane && !append_lane(path, lane, backwards)) return false;
        }
        return true;
    }
    struct point ahead = {position.x + cos(yaw), position.y + sin(yaw)};
    path->count = 0;
    bool done = append(path, position) && append(path, ahead);
    path->length = 0.0;
    return done;
}

/* --- Vehicles -------------------------------------------------------------------------------- */

/* Returns what an object lacks that is read, or NULL. */
static const char *lacking(const osi3_MovingObject *object) {
    const osi3_BaseMoving *base = &object->base;
    if (!base->has_position) return "position";
    if (!base->has_orientation) return "orientation";
    if (!base->has_velocity) return "velocity";
    if (!base->has_dimension) return "dimension";
    return NULL;
}

static bool is_finite(const osi3_MovingObject *object) {
    const osi3_BaseMoving *base = &object->base;
    double sum = base->position.x + base->position.y + base->orientation.yaw + base->velocity.x
        + base->velocity.y + base->dimension.length + base->dimension.width;
    return isfinite(sum + base->acceleration.x + base->acceleration.y);
}

static double along_heading(const osi3_Vector3d *vector, double heading) {
    return vector->x * cos(heading) + vector->y * sin(heading);
}

/* Half of a box's extent along a heading, or across it. */
static double half_length(const osi3_MovingObject *object, double heading) {
    double turn = object->base.orientation.yaw - heading;
    const osi3_Dimension3d *box = &object->base.dimension;
    return 0.5 * (box->length * fabs(cos(turn)) + box->width * fabs(sin(turn)));
}

static double half_width(const osi3_MovingObject *object, double heading) {
    return half_length(object, heading + 1.5707963267948966);
}

/* Returns speed and acceleration along a heading, and keeps the speed for the next scene. Nobody
   drives backwards, for which there is no driving model: such a vehicle stands. */
static void motion_of(
    const osi3_MovingObject *object, double heading, double time, const struct seen *before,
    struct seen *seen, double *speed, double *acceleration) {
    *speed = fmax(0.0, along_heading(&object->base.velocity, heading));
    *acceleration = 0.0;
    if (object->base.has_acceleration)
        *acceleration = along_heading(&object->base.acceleration, heading);
    else if (before->any && before->id == object->id.value && time > before->time)
        *acceleration = (*speed - before->speed) / (time - before->time);
    *seen = (struct seen){true, object->id.value, time, *speed};
}

/* Says whether an object is in the way of the ego vehicle: it is in a lane of the path; or, where
   it has no lane or the path follows none there, it overlaps what the ego vehicle will drive over. */
static bool is_in_the_way(
    const struct scene *scene, const osi3_MovingObject *object, const struct place *place) {
    for (size_t k = 0; k < lanes_of(object); k++)
        if (is_on(&scene->path, assigned_lane(object, k))) return true;
    if (lanes_of(object) > 0 && place->along <= scene->path.length) return false;
    double widths = half_width(object, place->heading) + half_width(scene->ego, scene->place.heading);
    return fabs(place->aside - scene->place.aside) < widths;
}

/* --- Scenes ---------------------------------------------------------------------------------- */

static double seconds_of(const osi3_Timestamp *time) { return (double)time->seconds + 1e-9 * time->nanos; }

/* Finds a vehicle, its path and the nearest vehicle in its way.

   Args:
       scene: with what was seen in the last one; what it holds is freed by `leave`.
       view: of OSI.
       map: has the lanes.
       id: of the vehicle; -1 for the host vehicle.
       time: of the scene, where it has no timestamp, s.
       problem: is given a sentence where the status is not OK. */
static status look(
    struct scene *scene, const osi3_SensorView *view, const osi3_GroundTruth *map, int64_t id,
    double time, char problem[256]) {
    const osi3_GroundTruth *truth = &view->global_ground_truth;
    struct seen before = scene->seen, leader_before = scene->leader_seen;
    memset(scene, 0, sizeof *scene);
    scene->time = time;
    if (view->has_timestamp) scene->time = seconds_of(&view->timestamp);
    else if (truth->has_timestamp) scene->time = seconds_of(&truth->timestamp);
    if (id < 0 && !view->has_host_vehicle_id && !truth->has_host_vehicle_id) {
        snprintf(problem, 256, "the sensor view names no host vehicle; set its host_vehicle_id, or"
                 " the parameter vehicle_id");
        return ERROR;
    }
    uint64_t ego = (uint64_t)id;
    if (id < 0) ego = view->has_host_vehicle_id ? view->host_vehicle_id.value : truth->host_vehicle_id.value;
    for (size_t k = 0; k < truth->moving_object_count; k++) {
        const osi3_MovingObject *object = &truth->moving_object[k];
        const char *name = lacking(object);
        if (name) {
            snprintf(problem, 256, "moving object %llu has no %s; the driver reads position,"
                     " orientation, velocity and dimension of each",
                     (unsigned long long)object->id.value, name);
            return ERROR;
        }
        if (!is_finite(object)) {
            snprintf(problem, 256, "the step is discarded, as a number of moving object %llu is none",
                     (unsigned long long)object->id.value);
            return DISCARD;
        }
        if (object->id.value == ego) scene->ego = object;
    }
    if (!scene->ego) {
        snprintf(problem, 256, "vehicle %llu, which is driven, is not among the %zu moving objects of"
                 " the sensor view", (unsigned long long)ego, (size_t)truth->moving_object_count);
        return ERROR;
    }
    if (!find_path(&scene->path, map, scene->ego)) {
        snprintf(problem, 256, "there is no memory for the lanes of the sensor view");
        return ERROR;
    }
    scene->place = place_of(&scene->path, point_of(&scene->ego->base.position));
    motion_of(scene->ego, scene->place.heading, scene->time, &before, &scene->seen, &scene->speed,
              &scene->acceleration);
    double front = scene->place.along + half_length(scene->ego, scene->place.heading);
    const osi3_MovingObject *leader = NULL;
    double heading = 0.0;
    scene->gap = INFINITY;
    for (size_t k = 0; k < truth->moving_object_count; k++) {
        const osi3_MovingObject *object = &truth->moving_object[k];
        struct place place = place_of(&scene->path, point_of(&object->base.position));
        if (object == scene->ego || place.along <= scene->place.along) continue;
        double gap = place.along - half_length(object, place.heading) - front;
        if (gap < scene->gap && is_in_the_way(scene, object, &place)) {
            scene->gap = gap;
            leader = object;
            heading = place.heading;
        }
    }
    if (leader)
        motion_of(leader, heading, scene->time, &leader_before, &scene->leader_seen,
                  &scene->leader_speed, &scene->leader_acceleration);
    return OK;
}

static void leave(struct scene *scene) { free(scene->path.points); }

/* Returns the ego vehicle after a step, in which it keeps its distance and angle to the path.

   Args:
       scene: before the step.
       driven: m along the path.
       speed, acceleration: at its end, m/s, m/s2.
       length: of the step, s. */
static osi3_MovingObject moved(
    const struct scene *scene, double driven, double speed, double acceleration, double length) {
    const osi3_BaseMoving *base = &scene->ego->base;
    struct place from = scene->place, to = scene->place;
    to.along += driven;
    struct point a = point_at(&scene->path, &from), b = point_at(&scene->path, &to);
    double turn = turned(to.heading - scene->place.heading);
    double x = cos(to.heading), y = sin(to.heading);
    osi3_MovingObject object = osi3_MovingObject_init_zero;
    object.has_id = true;
    object.id = scene->ego->id;
    object.has_base = true;
    object.base.has_position = true;
    object.base.position = base->position;
    object.base.position.x += b.x - a.x;
    object.base.position.y += b.y - a.y;
    object.base.has_orientation = true;
    object.base.orientation = base->orientation;
    object.base.orientation.has_yaw = true;
    object.base.orientation.yaw = turned(base->orientation.yaw + turn);
    object.base.has_velocity = object.base.has_acceleration = true;
    object.base.velocity = (osi3_Vector3d){true, speed * x, true, speed * y, true, 0.0};
    object.base.acceleration = (osi3_Vector3d){true, acceleration * x, true, acceleration * y, true, 0.0};
    object.base.has_orientation_rate = true;
    object.base.orientation_rate = (osi3_Orientation3d){true, 0.0, true, 0.0, true, turn / length};
    return object;
}
