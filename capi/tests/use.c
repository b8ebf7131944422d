// What a C program does with the library: a stream in pieces, Gaussians, a picture; mistakes; two threads at once.
#include "b2p.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static char message[256];

#define CHECK(condition)                                                                                                       \
    do {                                                                                                                       \
        if (!(condition)) {                                                                                                    \
            fprintf(stderr, "line %d: %s (%s)\n", __LINE__, #condition, message);                                              \
            exit(1);                                                                                                           \
        }                                                                                                                      \
    } while (0)

typedef struct {
    uint8_t *bytes;
    size_t length;
} file;

static file read_file(const char *path) {
    FILE *from = fopen(path, "rb");
    CHECK(from);
    CHECK(fseek(from, 0, SEEK_END) == 0);
    file f = {NULL, (size_t)ftell(from)};
    rewind(from);
    f.bytes = malloc(f.length);
    CHECK(f.bytes && fread(f.bytes, 1, f.length, from) == f.length);
    fclose(from);
    return f;
}

typedef struct {
    const b2p_model *model;
    const file *stream;
    bool quick;
    uint64_t sum;
} job;

// Decodes the stream in pieces of 100 bytes and draws it; the sum is that of the picture's bytes.
static void *decode(void *argument) {
    job *job = argument;
    char message[256];
    b2p_decoding *decoding = NULL;
    CHECK(b2p_decoding_start(job->model, NULL, NULL, -1, &decoding, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_use_quick_heads(decoding, job->quick, message, sizeof message) == B2P_STATUS_OK);
    int32_t level, last = -1;
    for (size_t at = 0; at < job->stream->length; at += 100) {
        size_t left = job->stream->length - at;
        CHECK(b2p_decoding_push(decoding, job->stream->bytes + at, left < 100 ? left : 100, NULL, 0) == B2P_STATUS_OK);
        do {
            CHECK(b2p_decoding_advance(decoding, &level, message, sizeof message) == B2P_STATUS_OK);
            CHECK(level == -1 || level == b2p_decoding_level(decoding));
            last = level == -1 ? last : level;
        } while (level != -1);
    }
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_OK);
    CHECK(last == b2p_decoding_level(decoding));
    b2p_gaussians *gaussians = NULL;
    CHECK(b2p_decoding_gaussians(decoding, &gaussians, message, sizeof message) == B2P_STATUS_OK);
    b2p_decoding_free(decoding);

    b2p_arrays arrays;
    CHECK(b2p_gaussians_arrays(gaussians, &arrays, message, sizeof message) == B2P_STATUS_OK);
    CHECK(arrays.count > 0 && arrays.unit > 0);
    for (size_t i = 0; i < 3 * arrays.count; i++) {
        CHECK(arrays.position[i] > -2 && arrays.position[i] < 2);
        CHECK(arrays.scale[i] >= 0 && arrays.colour[i] >= 0 && arrays.colour[i] <= 1);
    }
    for (size_t i = 0; i < arrays.count; i++) {
        const float *q = arrays.rotation + 4 * i;
        float norm = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
        CHECK(norm > 0.999f && norm < 1.001f && arrays.opacity[i] <= 1);
    }

    b2p_camera camera = {.azimuth = 20, .elevation = 10, .distance = 3, .fov = 45, .width = 40, .height = 30, .background = {1, 1, 1}};
    uint8_t pixels[4 * 40 * 30];
    b2p_status drawn = b2p_render(gaussians, &camera, NULL, pixels, sizeof pixels, message, sizeof message);
    CHECK(drawn == B2P_STATUS_OK);
    for (size_t i = 0; i < sizeof pixels; i++) {
        job->sum = job->sum * 31 + pixels[i];
    }
    CHECK(pixels[3] == 255);
    CHECK(b2p_render(gaussians, &camera, NULL, pixels, 7, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(strstr(message, "4800") && strstr(message, "7"));
    b2p_limits few = b2p_limits_default();
    few.max_pixels = 100;
    CHECK(b2p_render(gaussians, &camera, &few, pixels, sizeof pixels, message, sizeof message) == B2P_STATUS_LIMIT);
    b2p_gaussians_free(gaussians);
    return NULL;
}

static void mistakes(const b2p_model *model, file stream) {
    b2p_model *none = NULL;
    CHECK(b2p_model_open("/no/such/model", &none, message, sizeof message) == B2P_STATUS_IO);
    CHECK(strstr(message, "/no/such/model"));
    char little[4];
    CHECK(b2p_model_open("/no/such/model", &none, little, sizeof little) == B2P_STATUS_IO);
    CHECK(strlen(little) == 3);
    CHECK(b2p_model_open(NULL, &none, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_model_from_bytes(stream.bytes, stream.length, &none, message, sizeof message) == B2P_STATUS_MALFORMED);
    CHECK(none == NULL);

    b2p_decoding *decoding = NULL;
    // Without a model, a stream of version 2 says which it needs.
    CHECK(b2p_decoding_start(NULL, NULL, NULL, -1, &decoding, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_use_heads(decoding, 3, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_push(decoding, stream.bytes, stream.length, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_MODEL);
    CHECK(strstr(message, "no model"));
    b2p_decoding_free(decoding);
    CHECK(b2p_decoding_start(model, NULL, NULL, 256, &decoding, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_push(NULL, stream.bytes, stream.length, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_level(NULL) == -1);

    // No quick heads, cut, damaged, over the limits, cancelled.
    b2p_gaussians *gaussians = NULL;
    CHECK(b2p_decoding_use_quick_heads(NULL, true, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_start(model, NULL, NULL, -1, &decoding, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_use_quick_heads(decoding, true, message, sizeof message) == B2P_STATUS_UNSUPPORTED);
    CHECK(strstr(message, "quick"));
    CHECK(b2p_decoding_gaussians(decoding, &gaussians, message, sizeof message) == B2P_STATUS_USAGE);
    b2p_points *points = NULL;
    CHECK(b2p_decoding_points(decoding, &points, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_push(decoding, stream.bytes, stream.length - 1, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_TRUNCATED);
    CHECK(b2p_decoding_level(decoding) >= 0);
    CHECK(b2p_decoding_points(decoding, &points, message, sizeof message) == B2P_STATUS_UNSUPPORTED && points == NULL);
    CHECK(b2p_decoding_gaussians(decoding, &gaussians, message, sizeof message) == B2P_STATUS_OK);
    b2p_gaussians_free(gaussians);
    b2p_decoding_free(decoding);

    stream.bytes[stream.length - 1] ^= 1;
    CHECK(b2p_decoding_start(model, NULL, NULL, -1, &decoding, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_push(decoding, stream.bytes, stream.length, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_CHECKSUM);
    b2p_decoding_free(decoding);
    stream.bytes[stream.length - 1] ^= 1;

    b2p_limits limits = b2p_limits_embedded();
    limits.max_bytes = 1000;
    b2p_cancel *cancel = NULL;
    CHECK(b2p_cancel_new(&cancel, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_start(model, &limits, cancel, -1, &decoding, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_push(decoding, stream.bytes, stream.length, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_LIMIT);
    CHECK(strstr(message, "max_bytes"));
    b2p_decoding_free(decoding);
    CHECK(b2p_decoding_start(model, NULL, cancel, -1, &decoding, NULL, 0) == B2P_STATUS_OK);
    b2p_cancel_throw(cancel);
    b2p_cancel_free(cancel);
    CHECK(b2p_decoding_push(decoding, stream.bytes, stream.length, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_CANCELLED);
    b2p_decoding_free(decoding);

    b2p_model_free(NULL);
    b2p_decoding_free(NULL);
    b2p_gaussians_free(NULL);
    b2p_cancel_free(NULL);
    b2p_cancel_throw(NULL);
}

/* The voxels of a decoded level, printed for the caller to compare. */
static void points(b2p_decoding *decoding, const b2p_arrays *frame) {
    b2p_points *voxels = NULL;
    CHECK(b2p_decoding_points(decoding, NULL, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_points(NULL, &voxels, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_points(decoding, &voxels, message, sizeof message) == B2P_STATUS_OK);
    b2p_point_arrays arrays;
    CHECK(b2p_points_arrays(voxels, NULL, NULL, 0) == B2P_STATUS_USAGE);
    CHECK(b2p_points_arrays(voxels, &arrays, NULL, 0) == B2P_STATUS_OK);
    CHECK(arrays.count > 0 && arrays.level == b2p_decoding_level(decoding));
    uint64_t sum = 0;
    for (size_t i = 0; i < 3 * arrays.count; i++) {
        CHECK(arrays.coordinate[i] < 1u << arrays.level);
        sum = sum * 31 + arrays.coordinate[i];
        sum = sum * 31 + arrays.colour[i];
    }
    for (int axis = 0; axis < 3; axis++) {
        CHECK(arrays.origin[axis] == frame->origin[axis]);
    }
    CHECK(arrays.voxel_size * (1u << arrays.level) == 2 * frame->unit);
    printf("%zu %016llx\n", arrays.count, (unsigned long long)sum);
    b2p_points_free(voxels);
    b2p_points_free(NULL);
}

typedef struct {
    size_t count, parts, most;
    double shapes, opacities;
} parts_seen;

/* Adds up a part, and stops after the most that are wanted. */
static bool add_part(const b2p_arrays *arrays, void *context) {
    parts_seen *seen = context;
    for (size_t i = 0; i < 3 * arrays->count; i++) {
        seen->shapes += arrays->position[i] + arrays->scale[i] + arrays->colour[i];
    }
    for (size_t i = 0; i < arrays->count; i++) {
        seen->opacities += arrays->opacity[i] + arrays->rotation[4 * i];
    }
    seen->count += arrays->count;
    return ++seen->parts < seen->most;
}

/* The Gaussians that come in parts are those that come at once. */
static void in_parts(file stream) {
    b2p_decoding *decoding = NULL;
    b2p_gaussians *gaussians = NULL;
    CHECK(b2p_decoding_use_parts(NULL, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_start(NULL, NULL, NULL, -1, &decoding, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_use_parts(decoding, message, sizeof message) == B2P_STATUS_OK);
    parts_seen seen = {0, 0, 1000, 0, 0};
    CHECK(b2p_decoding_gaussians_in_parts(decoding, add_part, &seen, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_push(decoding, stream.bytes, stream.length, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_use_parts(decoding, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_gaussians_in_parts(decoding, NULL, &seen, message, sizeof message) == B2P_STATUS_USAGE);
    CHECK(seen.parts == 0);
    CHECK(b2p_decoding_gaussians_in_parts(decoding, add_part, &seen, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_gaussians(decoding, &gaussians, message, sizeof message) == B2P_STATUS_OK);
    b2p_arrays whole;
    CHECK(b2p_gaussians_arrays(gaussians, &whole, NULL, 0) == B2P_STATUS_OK);
    parts_seen once = {0, 0, 1000, 0, 0};
    add_part(&whole, &once);
    CHECK(seen.count == once.count && seen.shapes == once.shapes && seen.opacities == once.opacities);
    b2p_gaussians_free(gaussians);
    seen.most = 0;
    CHECK(b2p_decoding_gaussians_in_parts(decoding, add_part, &seen, message, sizeof message) == B2P_STATUS_CANCELLED);
    b2p_decoding_free(decoding);
}

/* A stream of version 3 without a model, in two pieces. */
static void without_model(file stream) {
    b2p_decoding *decoding = NULL;
    b2p_gaussians *gaussians = NULL;
    CHECK(b2p_decoding_start(NULL, NULL, NULL, -1, &decoding, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_use_heads(decoding, B2P_HEADS_SURFELS, message, sizeof message) == B2P_STATUS_OK);
    b2p_heads_model *heads = NULL;
    CHECK(b2p_heads_model_from_bytes(stream.bytes, stream.length, &heads, message, sizeof message) == B2P_STATUS_MALFORMED);
    CHECK(b2p_decoding_use_heads_model(decoding, heads, message, sizeof message) == B2P_STATUS_USAGE);
    b2p_heads_model_free(heads);
    CHECK(b2p_decoding_push(decoding, stream.bytes, 9, NULL, 0) == B2P_STATUS_OK);
    int32_t level = 0;
    CHECK(b2p_decoding_advance(decoding, &level, message, sizeof message) == B2P_STATUS_OK && level == -1);
    CHECK(b2p_decoding_push(decoding, stream.bytes + 9, stream.length - 9, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_advance(decoding, &level, message, sizeof message) == B2P_STATUS_OK && level >= 0);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_gaussians(decoding, &gaussians, message, sizeof message) == B2P_STATUS_OK);
    b2p_arrays arrays;
    CHECK(b2p_gaussians_arrays(gaussians, &arrays, NULL, 0) == B2P_STATUS_OK && arrays.count > 0);
    b2p_gaussians_free(gaussians);
    points(decoding, &arrays);
    b2p_decoding_free(decoding);
}

/* A scene of blocks, in pieces, is what a stream is; a damaged block is named. */
static void scene(file scene) {
    b2p_decoding *decoding = NULL;
    b2p_gaussians *gaussians = NULL;
    CHECK(b2p_decoding_start(NULL, NULL, NULL, -1, &decoding, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_use_heads(decoding, B2P_HEADS_SURFELS, message, sizeof message) == B2P_STATUS_OK);
    int32_t level = -1, levels = 0;
    for (size_t at = 0; at < scene.length; at += 7) {
        size_t left = scene.length - at;
        CHECK(b2p_decoding_advance(decoding, &level, message, sizeof message) == B2P_STATUS_OK && level == -1);
        CHECK(b2p_decoding_push(decoding, scene.bytes + at, left < 7 ? left : 7, message, sizeof message) == B2P_STATUS_OK);
    }
    CHECK(b2p_decoding_gaussians(decoding, &gaussians, message, sizeof message) == B2P_STATUS_USAGE);
    for (;;) {
        CHECK(b2p_decoding_advance(decoding, &level, message, sizeof message) == B2P_STATUS_OK);
        if (level == -1) {
            break;
        }
        CHECK(level == b2p_decoding_level(decoding));
        levels++;
    }
    CHECK(levels == 3);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_decoding_gaussians(decoding, &gaussians, message, sizeof message) == B2P_STATUS_OK);
    b2p_arrays arrays;
    CHECK(b2p_gaussians_arrays(gaussians, &arrays, NULL, 0) == B2P_STATUS_OK && arrays.count > 0);
    b2p_gaussians_free(gaussians);
    points(decoding, &arrays);
    b2p_decoding_free(decoding);

    CHECK(b2p_decoding_start(NULL, NULL, NULL, -1, &decoding, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_push(decoding, scene.bytes, scene.length - 1, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_TRUNCATED);
    CHECK(b2p_decoding_level(decoding) == -1);
    uint8_t last = scene.bytes[scene.length - 1] ^ 1;
    CHECK(b2p_decoding_push(decoding, &last, 1, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_finish(decoding, message, sizeof message) == B2P_STATUS_OK);
    gaussians = NULL;
    CHECK(b2p_decoding_gaussians(decoding, &gaussians, message, sizeof message) == B2P_STATUS_MALFORMED);
    CHECK(strstr(message, "block") && gaussians == NULL);
    b2p_decoding_free(decoding);

    b2p_limits limits = b2p_limits_default();
    limits.max_bytes = scene.length - 1;
    CHECK(b2p_decoding_start(NULL, &limits, NULL, -1, &decoding, NULL, 0) == B2P_STATUS_OK);
    CHECK(b2p_decoding_push(decoding, scene.bytes, scene.length, message, sizeof message) == B2P_STATUS_LIMIT);
    b2p_decoding_free(decoding);
}

int main(int count, char **arguments) {
    // A model, a stream, the same model with quick heads as well, a stream of version 3, and a scene.
    CHECK(count == 6);
    file blocks = read_file(arguments[5]);
    scene(blocks);
    free(blocks.bytes);
    file new_stream = read_file(arguments[4]);
    without_model(new_stream);
    in_parts(new_stream);
    free(new_stream.bytes);
    file model_file = read_file(arguments[3]), stream = read_file(arguments[2]);
    b2p_model *model = NULL, *both = NULL;
    CHECK(b2p_model_open(arguments[1], &model, message, sizeof message) == B2P_STATUS_OK);
    CHECK(b2p_model_from_bytes(model_file.bytes, model_file.length, &both, message, sizeof message) == B2P_STATUS_OK);
    free(model_file.bytes);
    CHECK(strlen(b2p_version()) >= 5);
    CHECK(b2p_limits_unlimited().max_bytes > b2p_limits_default().max_bytes);

    mistakes(model, stream);
    job jobs[4] = {{model, &stream, false, 0}, {model, &stream, false, 0}, {both, &stream, false, 0}, {both, &stream, true, 0}};
    pthread_t threads[4];
    for (int i = 0; i < 4; i++) {
        CHECK(pthread_create(&threads[i], NULL, decode, &jobs[i]) == 0);
    }
    for (int i = 0; i < 4; i++) {
        CHECK(pthread_join(threads[i], NULL) == 0);
        CHECK(jobs[i].quick || jobs[i].sum == jobs[0].sum);
    }
    b2p_model_free(model);
    b2p_model_free(both);
    free(stream.bytes);
    printf("%016llx\n%016llx\n", (unsigned long long)jobs[0].sum, (unsigned long long)jobs[3].sum);
    return 0;
}
