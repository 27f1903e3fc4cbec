/*
 * compgs.h: decodes .cgs files (docs/bitstream.md) to arrays, and predicts what a camera sees of them.
 *
 *     #define COMPGS_IMPLEMENTATION      in one file of your program, before
 *     #include "compgs.h"
 *
 *     cgs_scene scene;
 *     if (cgs_decode(bytes, size, 0, &scene) != CGS_OK) puts(scene.message);
 *     float *gaussians = malloc(scene.coupled * CGS_GAUSSIAN * sizeof *gaussians + 1);
 *     long count = cgs_predict(&scene, center, gaussians);
 *     cgs_free(&scene);
 *
 * C99 or C++11; needs the standard library and -lm. It reads versions 2 to 5, whole files and their beginnings, and
 * refuses what the document refuses; positions by G-PCC it does not read. Nothing is kept: several threads may decode at
 * once. Allocations are bounded by the limits of the document. License: Apache-2.0, as the rest of CompGS.
 *
 * It has fewer than 1 500 lines of code: octree and arithmetic code 350, fields and container 240, networks and heads 170,
 * latents 150, streams, arrays and tables 190, Gaussians 80, masks 30, optional sections 70, the rest declares. Leaving
 * out versions 2 to 4 would save 40 of them, leaving out beginnings of files 15.
 */
#ifndef COMPGS_H
#define COMPGS_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef enum {
    CGS_OK,
    CGS_NOT_A_COMPGS_FILE,
    CGS_UNSUPPORTED_VERSION,
    CGS_TRUNCATED_SECTION,
    CGS_CORRUPT_SECTION,
    CGS_MISSING_DEPENDENCY, /* positions by G-PCC */
    CGS_OUT_OF_MEMORY
} cgs_error;

enum { CGS_MAX_GROUPS = 16, CGS_MAX_TENSORS = 42, CGS_GAUSSIAN = 14 };
enum { CGS_SIDE, CGS_REFERENCE, CGS_LOG_SCALES, CGS_RESIDUAL }; /* roles of groups */

/* Latents of a group; of rows that are anchors, with role CGS_RESIDUAL coupled primitives that exist. */
typedef struct {
    int role, channels, steps; /* steps: 0, 1 or channels */
    uint32_t context;
    float step[256];
    uint32_t rows;
    int32_t *symbols; /* [anchors, channels], with CGS_RESIDUAL [anchors, coupled_primitives, channels] */
    int32_t *latents; /* [rows, channels], in 4096ths of a step */
} cgs_group;

/* A parameter of the prediction heads is its integer times 2^-exponent. */
typedef struct {
    uint32_t rows, columns; /* a vector has one row */
    int exponent;
    int32_t *values;
} cgs_tensor;

typedef struct {
    double rotation[4]; /* w, x, y, z: world to camera */
    double position[3]; /* world units, local frame */
    int width, height;
    float fx, fy;
} cgs_view;

typedef struct {
    char message[128]; /* what is wrong, if something is */
    int version;
    uint32_t total_anchors;    /* of the whole file */
    uint32_t anchors, coupled; /* that are there: fewer for the beginning of a file */
    int coupled_primitives, residual_dim, reference_dim, heads, width, depth; /* heads: 0 separate, 1 paired, 2 shallow */
    double voxel_size, world_offset[3], view_distance_scale;
    float background[3], angular_dilation; /* angular_dilation 0: the file has none */
    int32_t *coordinates;                  /* [anchors, 3], canonical order */
    uint8_t *mask;                         /* [anchors, coupled_primitives] 0 or 1 */
    int groups;
    cgs_group group[CGS_MAX_GROUPS];
    int tensors; /* in the order of version 5 */
    cgs_tensor tensor[CGS_MAX_TENSORS];
    double up[3]; /* unit vector; only with views */
    int views;
    cgs_view *view;
    void *memory;
} cgs_scene;

/* The scene in the bytes of a file; with `prefix` the file may end early. Also after an error there is nothing to free. */
cgs_error cgs_decode(const uint8_t *data, size_t size, int prefix, cgs_scene *scene);

void cgs_free(cgs_scene *scene);

/* The document's name of an error. */
const char *cgs_error_name(cgs_error error);

/*
 * The Gaussians that a camera at `center` (local frame: world minus world_offset) sees, into `out`, which has room for
 * scene->coupled of them: mean, scales, quaternion w-x-y-z, opacity, color. Returns their number, -1 without memory.
 */
long cgs_predict(const cgs_scene *scene, const double center[3], float *out);

#ifdef __cplusplus
}
#endif
#endif /* COMPGS_H */

#ifdef COMPGS_IMPLEMENTATION

#include <float.h>
#include <math.h>
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* ---- constants, by their names in the document */

enum {
    CGS__VERSION = 5, CGS__OLDEST_VERSION = 2, CGS__FIRST_WITH_NEIGHBOURS = 3, CGS__FIRST_WITH_DILATION = 4,
    CGS__FIRST_WITH_ROWS = 5, CGS__OPTIONAL = 0x80, CGS__MAX_SECTIONS = 64, CGS__MAX_ANCHORS = 1 << 24,
    CGS__MAX_RANGES = 22, CGS__MAX_TABLES = 256, CGS__MAX_SYMBOL = 1 << 18, CGS__MAX_METADATA_BYTES = 4096,
    CGS__GAUSSIAN_COUNT = 128, CGS__SCALES_PER_OCTAVE = 12, CGS__MAX_HYPER_SYMBOLS = 1024,
    CGS__CHUNK_SYMBOLS = 1 << 20, CGS__SINGLE_STATE_SYMBOLS = 1 << 18, CGS__MAX_ESCAPE_BYTES = 5,
    CGS__ACTIVATION_LIMIT = 1 << 23, CGS__MAX_SHIFT = 30, CGS__MAX_LAYERS = 8, CGS__MAX_LAYER_WIDTH = 1 << 16,
    CGS__MAX_NAME_BYTES = 64, CGS__MAX_EXPONENT = 62, CGS__MAX_WEIGHTS = 1 << 22,
    CGS__MAX_LOW_BITS = 26, CGS__FOLLOW_LIMIT = 1 << 28, CGS__CHAIN_LIMIT = 1 << 12, CGS__MAX_INERTIA = 63,
    CGS__SIZE_OFFSET = 1229, CGS__SIZE_CAP = 4, CGS__LARGEST_TABLE_SHIFT = 36, CGS__MAX_DEPTH = 21, CGS__ONE = 4096
};

/* Sections. */
enum { CGS__SCENE = 1, CGS__POSITIONS, CGS__GPCC, CGS__MASKS, CGS__TABLES, CGS__NETWORKS, CGS__HEADS, CGS__LATENTS };
enum { CGS__METADATA = 129, CGS__PADDING, CGS__VIEWPOINTS };

/* What is free, and how much of it each byte of a file brings. */
typedef struct {
    int64_t free, per_byte;
} cgs__limit;
static const cgs__limit CGS__SYMBOLS = {1 << 20, 128};
static const cgs__limit CGS__NETWORK_PRODUCTS = {1 << 28, 1 << 15};
static const cgs__limit CGS__HEAD_PRODUCTS = {1 << 30, 1 << 17};
static const cgs__limit CGS__FLAGS = {1 << 20, 16};
static const cgs__limit CGS__NODES = {1 << 18, 4};

/* ---- what a decoder knows */

typedef struct {
    int32_t lowest, entries;   /* entries: the escape, which comes last, included */
    int64_t expected;          /* E, of a Gaussian table */
    const uint32_t *cumulated; /* [entries + 1] */
} cgs__table;

typedef struct {
    int inputs, outputs, shift, adds, rectify;
    int32_t *weight; /* [outputs, inputs] */
    int32_t *bias;
} cgs__layer;

typedef struct {
    int layers, skip, has_chain, follow_shift, inertia, widest; /* widest: of all rows within it */
    cgs__layer layer[CGS__MAX_LAYERS];
    int32_t *follow, *chain; /* or NULL */
} cgs__network;

typedef struct cgs__block {
    struct cgs__block *before;
    uint64_t alignment; /* of what follows it */
} cgs__block;

typedef struct {
    struct cgs__decoder *d;
    const uint8_t *data;
    size_t size, at;
} cgs__fields;

typedef struct cgs__decoder {
    jmp_buf jump;
    cgs_error error;
    cgs_scene *scene;
    cgs__block *blocks;
    const char *section; /* that is read, for messages */
    const uint8_t *data;
    size_t size;
    int prefix, sections, whole; /* whole: all latents that the header names are there */
    int number[CGS__MAX_SECTIONS]; /* of each section */
    cgs__fields section_of[CGS__MAX_SECTIONS];
    cgs__table gaussian[CGS__GAUSSIAN_COUNT];
    int32_t ratio[2 * CGS__LARGEST_TABLE_SHIFT + 1]; /* M */
    uint16_t squash[4096], rate[1024];
    int16_t stretch[4096], confidence[1024];
    int32_t *offsets; /* [total_anchors, 3], canonical order */
    uint8_t *mask;    /* [total_anchors, coupled_primitives] */
    uint32_t up_to_level[CGS__MAX_DEPTH + 1];
    uint32_t promised_coupled;
    cgs__table *tables[CGS_MAX_GROUPS];    /* of groups that have tables */
    cgs__network *network[CGS_MAX_GROUPS]; /* of the others */
} cgs__decoder;

static void cgs__fail(cgs__decoder *d, cgs_error error, const char *what) {
    d->error = error;
    snprintf(d->scene->message, sizeof d->scene->message, "%s: %s", d->section, what);
    longjmp(d->jump, 1);
}

static void cgs__require(cgs__decoder *d, int legal, const char *what) {
    if (!legal) cgs__fail(d, CGS_CORRUPT_SECTION, what);
}

/* Zeros, which belong to the decoder until the end, or until all behind a mark, `blocks` of before, is released. */
static void *cgs__alloc(cgs__decoder *d, uint64_t count, size_t size) {
    cgs__block *block = NULL;
    if (count < (SIZE_MAX - sizeof *block) / size)
        block = (cgs__block *)calloc(1, sizeof *block + (size_t)count * size);
    if (!block) cgs__fail(d, CGS_OUT_OF_MEMORY, "out of memory");
    block->before = d->blocks;
    d->blocks = block;
    return block + 1;
}

#define CGS__NEW(d, type, count) ((type *)cgs__alloc((d), (uint64_t)(count), sizeof(type)))

static cgs__block *cgs__release(cgs__block *block, const cgs__block *mark) {
    while (block != mark) {
        cgs__block *before = block->before;
        free(block);
        block = before;
    }
    return block;
}

/* Arithmetic shift, also where that of the machine is another. */
static int64_t cgs__right(int64_t v, int bits) { return v >= 0 ? v >> bits : ~(~v >> bits); }

static int64_t cgs__clamp(int64_t v, int64_t low, int64_t high) { return v < low ? low : v > high ? high : v; }

static int cgs__least(int a, int b) { return a < b ? a : b; }

static int cgs__most(int a, int b) { return a > b ? a : b; }

static int64_t cgs__size(int64_t v) { return v < 0 ? -v : v; }

static int32_t cgs__activation(int64_t v) {
    return (int32_t)cgs__clamp(v, -CGS__ACTIVATION_LIMIT, CGS__ACTIVATION_LIMIT - 1);
}

/* b > 0 */
static int64_t cgs__floor_div(int64_t a, int64_t b) { return a >= 0 ? a / b : -((-a + b - 1) / b); }

static int cgs__ones(int v) {
    int count = 0;
    for (; v; v &= v - 1) count++;
    return count;
}

static uint32_t cgs__crc32(const uint8_t *data, size_t size) {
    uint32_t table[256], crc = 0xffffffffu;
    for (uint32_t i = 0; i < 256; i++) {
        table[i] = i;
        for (int bit = 0; bit < 8; bit++) table[i] = (table[i] & 1 ? 0xedb88320u : 0) ^ (table[i] >> 1);
    }
    while (size--) crc = table[(crc ^ *data++) & 255] ^ (crc >> 8);
    return ~crc;
}

static uint64_t cgs__little(const uint8_t *data, int bytes) {
    uint64_t value = 0;
    while (bytes--) value = value << 8 | data[bytes];
    return value;
}

static void cgs__check(cgs__decoder *d, cgs__limit limit, uint64_t amount, const char *what) {
    cgs__require(d, amount <= (uint64_t)(limit.free + limit.per_byte * (int64_t)d->size), what);
}

/* ---- fields */

static const uint8_t *cgs__take(cgs__fields *f, uint64_t bytes) {
    cgs__require(f->d, bytes <= f->size - f->at, "the section ends within a field");
    f->at += (size_t)bytes;
    return f->data + f->at - bytes;
}

/* Fields of their own in the next bytes. */
static cgs__fields cgs__part(cgs__fields *f, uint64_t bytes) {
    cgs__fields part = {f->d, cgs__take(f, bytes), (size_t)bytes, 0};
    return part;
}

static uint64_t cgs__unsigned(cgs__fields *f, int bytes) { return cgs__little(cgs__take(f, (uint64_t)bytes), bytes); }

static uint64_t cgs__between(cgs__fields *f, uint64_t value, uint64_t lowest, uint64_t highest, const char *what) {
    cgs__require(f->d, value >= lowest && value <= highest, what);
    return value;
}

static int cgs__int(cgs__fields *f, int bytes, int lowest, int highest, const char *what) {
    return (int)cgs__between(f, cgs__unsigned(f, bytes), (uint64_t)lowest, (uint64_t)highest, what);
}

static uint64_t cgs__raw_varint(cgs__fields *f, int most_bytes) {
    uint64_t value = 0;
    for (int i = 0; i < most_bytes; i++) {
        const uint8_t byte = *cgs__take(f, 1);
        value |= (uint64_t)(byte & 127) << (7 * i);
        if (byte > 127) continue;
        cgs__require(f->d, byte || !i, "a number is spelled with a needless byte");
        return value;
    }
    cgs__fail(f->d, CGS_CORRUPT_SECTION, "a number has too many bytes");
    return 0;
}

static uint64_t cgs__varint(cgs__fields *f, uint64_t lowest, uint64_t highest, const char *what) {
    return cgs__between(f, cgs__raw_varint(f, 9), lowest, highest, what);
}

static int64_t cgs__signed(cgs__fields *f, int most_bytes, int64_t limit, const char *what) {
    const uint64_t raw = cgs__raw_varint(f, most_bytes);
    const int64_t value = raw & 1 ? -(int64_t)(raw >> 1) - 1 : (int64_t)(raw >> 1);
    cgs__require(f->d, value >= -limit && value <= limit, what);
    return value;
}

/* A floating-point number of 4 or 8 bytes. */
static double cgs__real(cgs__fields *f, int bytes, double lowest, double highest, const char *what) {
    const uint64_t bits = cgs__unsigned(f, bytes);
    const uint32_t low = (uint32_t)bits;
    double value;
    float single;
    memcpy(&value, &bits, sizeof value);
    memcpy(&single, &low, sizeof single);
    if (bytes == 4) value = single;
    cgs__require(f->d, value >= lowest && value <= highest, what); /* not so for NaN */
    return value;
}

static float cgs__length(cgs__fields *f) {
    return (float)cgs__real(f, 4, ldexp(1, -149), FLT_MAX, "a length is not above 0 and finite");
}

static void cgs__end(cgs__fields *f) { cgs__require(f->d, f->at == f->size, "bytes are left over after the last field"); }

static void cgs__skip_text(cgs__fields *f, uint64_t size) { /* well-formed UTF-8 */
    static const uint32_t least[4] = {0, 0x80, 0x800, 0x10000};
    const uint8_t *text = cgs__take(f, size), *end = text + size;
    while (text < end) {
        uint32_t code = *text++;
        const int more = code < 0xc0 ? 0 : code < 0xe0 ? 1 : code < 0xf0 ? 2 : 3;
        cgs__require(f->d, (code < 0x80 || (code >= 0xc0 && code < 0xf8)) && end - text >= more, "not UTF-8");
        if (more) code &= 63u >> more;
        for (int i = 0; i < more; i++) {
            cgs__require(f->d, *text >> 6 == 2, "not UTF-8");
            code = code << 6 | (*text++ & 63);
        }
        cgs__require(f->d, code >= least[more] && code >> 11 != 27 && code < 0x110000, "not UTF-8");
    }
}

/* ---- file */

static const char *cgs__name(int number) {
    static const char *const names[] = {"", "scene", "positions", "positions (G-PCC)", "masks", "tables",
                                        "entropy networks", "prediction heads", "latents"};
    if (number <= CGS__LATENTS) return names[number];
    return number == CGS__METADATA ? "metadata" : number == CGS__PADDING ? "padding"
         : number == CGS__VIEWPOINTS ? "viewpoints" : "optional section";
}

/* The fields of a section; without data if it is not there. */
static cgs__fields cgs__open(cgs__decoder *d, int number) {
    cgs__fields f = {d, NULL, 0, 0};
    d->section = cgs__name(number);
    for (int i = d->sections - 1; i >= 0; i--)
        if (d->number[i] == number) f = d->section_of[i];
    return f;
}

static void cgs__check_numbers(cgs__decoder *d, const uint8_t *table, int count) {
    int seen[256] = {0}, before = 0;
    for (int i = 0; i < count; i++)
        if (table[9 * i] < CGS__OPTIONAL && (table[9 * i] < CGS__SCENE || table[9 * i] > CGS__LATENTS))
            cgs__fail(d, CGS_UNSUPPORTED_VERSION, "a section is unknown and must not be skipped");
    for (int i = 0; i < count; i++) {
        const int number = table[9 * i];
        cgs__require(d, !seen[number]++ || number == CGS__LATENTS, "a section is there twice");
        cgs__require(d, number >= CGS__OPTIONAL || number >= before, "the sections are not in order");
        if (number < CGS__OPTIONAL) before = number;
    }
    for (int i = CGS__SCENE; i <= CGS__LATENTS; i++)
        cgs__require(d, seen[i] || i == CGS__POSITIONS || i == CGS__GPCC, "a section is missing");
    cgs__require(d, seen[CGS__POSITIONS] + seen[CGS__GPCC] == 1, "expected one section of positions");
    cgs__require(d, seen[CGS__LATENTS] <= CGS__MAX_RANGES, "there are too many sections of latents");
}

static void cgs__unpack(cgs__decoder *d) {
    static const uint8_t magic[4] = {0x93, 'C', 'G', 'S'};
    const uint8_t *data = d->data;
    int has_latents = 0;
    d->section = "header";
    if (memcmp(data, magic, d->size < 4 ? d->size : 4)) cgs__fail(d, CGS_NOT_A_COMPGS_FILE, "not a .cgs file");
    if (d->size < 7) cgs__fail(d, CGS_TRUNCATED_SECTION, "the file ends within it");
    if (data[4] < CGS__OLDEST_VERSION || data[4] > CGS__VERSION)
        cgs__fail(d, CGS_UNSUPPORTED_VERSION, "a version that this decoder does not read");
    d->scene->version = data[4];
    const int count = data[6];
    size_t at = 11 + 9 * (size_t)count;
    if (d->size < at) cgs__fail(d, CGS_TRUNCATED_SECTION, "the file ends within it");
    cgs__require(d, cgs__crc32(data, at - 4) == cgs__little(data + at - 4, 4), "its checksum does not match");
    cgs__require(d, !data[5], "reserved flags are set");
    cgs__require(d, count <= CGS__MAX_SECTIONS, "too many sections");
    cgs__check_numbers(d, data + 7, count);
    d->whole = 1;
    for (int i = 0; i < count; i++) {
        const uint8_t *entry = data + 7 + 9 * i;
        const cgs__fields section = {d, data + at, (size_t)cgs__little(entry + 1, 4), 0};
        d->section = cgs__name(entry[0]);
        if (section.size > d->size - at) {
            if (!d->prefix || !has_latents) cgs__fail(d, CGS_TRUNCATED_SECTION, "the file ends within it");
            for (; i < count; i++) d->whole &= data[7 + 9 * i] != CGS__LATENTS;
            return;
        }
        cgs__require(d, cgs__crc32(section.data, section.size) == cgs__little(entry + 5, 4), "its checksum does not match");
        has_latents |= entry[0] == CGS__LATENTS;
        at += section.size;
        d->number[d->sections] = entry[0];
        d->section_of[d->sections++] = section;
    }
    d->section = "file";
    cgs__require(d, at == d->size, "bytes are left over after the last section");
}

/* ---- scene */

static int cgs__sees(const cgs_scene *s, int i, int group) { return s->group[i].context >> (group + 1) & 1; }

static int cgs__width(const cgs_scene *s, int i) {
    return (s->group[i].role == CGS_RESIDUAL ? s->coupled_primitives : 1) * s->group[i].channels;
}

static int cgs__inputs(const cgs_scene *s, int i) {
    int inputs = 3 * (int)(s->group[i].context & 1) + 2 * cgs__sees(s, i, i);
    for (int j = 0; j < i; j++) inputs += cgs__sees(s, i, j) ? s->group[j].channels : 0;
    return inputs;
}

static void cgs__read_group(cgs__fields *f, cgs_scene *s, int i) {
    static const int most[] = {64, 256, 6, 64};
    cgs_group *g = s->group + i;
    const int contexts = i + 1 + (s->version >= CGS__FIRST_WITH_NEIGHBOURS);
    g->role = (int)cgs__varint(f, 0, 3, "role of a group");
    g->channels = (int)cgs__varint(f, 1, (uint64_t)most[g->role], "channels of a group");
    g->context = (uint32_t)cgs__varint(f, 0, ((uint64_t)1 << contexts) - 1, "context of a group");
    g->steps = (int)cgs__varint(f, 0, (uint64_t)g->channels, "steps of a group");
    cgs__require(f->d, g->role == CGS_SIDE ? !g->steps : g->steps == 1 || g->steps == g->channels, "steps of a group");
    for (int j = 0; j < g->steps; j++) g->step[j] = (float)cgs__real(f, 4, ldexp(1, -64), ldexp(1, 64), "a step");
    for (int j = 0; j < i; j++)
        cgs__require(f->d, !cgs__sees(s, i, j) || s->group[j].role != CGS_RESIDUAL, "a group takes residuals");
    cgs__require(f->d, !(g->role == CGS_RESIDUAL && cgs__sees(s, i, i)), "residuals take what neighbours have");
    cgs__require(f->d, g->context || cgs__width(s, i) <= CGS__MAX_TABLES, "a group has too many tables");
}

static void cgs__read_scene(cgs__decoder *d) {
    const double small = ldexp(1, -64), large = ldexp(1, 64);
    cgs__fields f = cgs__open(d, CGS__SCENE);
    cgs_scene *s = d->scene;
    int channels[4] = {0};
    s->total_anchors = (uint32_t)cgs__int(&f, 4, 1, CGS__MAX_ANCHORS, "number of anchors");
    d->promised_coupled = (uint32_t)cgs__unsigned(&f, 4);
    s->coupled_primitives = cgs__int(&f, 1, 1, 64, "coupled_primitives");
    cgs__require(d, d->promised_coupled <= s->total_anchors * (uint64_t)s->coupled_primitives,
                 "more coupled primitives than slots");
    s->residual_dim = cgs__int(&f, 1, 1, 64, "residual_dim");
    s->heads = cgs__int(&f, 1, 0, 2, "heads");
    s->width = cgs__int(&f, 2, 1, 1024, "width");
    s->voxel_size = cgs__real(&f, 8, small, large, "voxel_size");
    for (int i = 0; i < 3; i++) s->world_offset[i] = cgs__real(&f, 8, -large, large, "world_offset");
    s->view_distance_scale = cgs__real(&f, 8, small, large, "view_distance_scale");
    for (int i = 0; i < 3; i++) s->background[i] = (float)cgs__real(&f, 4, -large, large, "background");
    if (s->version >= CGS__FIRST_WITH_DILATION)
        s->angular_dilation = (float)cgs__real(&f, 4, ldexp(1, -40), 1, "angular_dilation");
    s->groups = cgs__int(&f, 1, 1, CGS_MAX_GROUPS, "number of groups");
    for (int i = 0; i < s->groups; i++) {
        cgs__read_group(&f, s, i);
        channels[s->group[i].role] += s->group[i].channels;
    }
    cgs__end(&f);
    s->reference_dim = channels[CGS_REFERENCE];
    cgs__require(d, s->reference_dim >= 1 && s->reference_dim <= 256, "channels of references");
    cgs__require(d, channels[CGS_LOG_SCALES] == 6, "channels of log scales");
    cgs__require(d, !channels[CGS_RESIDUAL] || channels[CGS_RESIDUAL] == s->residual_dim, "channels of residuals");
}

/* ---- tables that are computed */

/*
 * The Gaussian tables, whose checksum the document gives. No number before rounding is nearer than 2e-5 to where it would
 * be rounded the other way, so that any library of mathematics gives these.
 */
static void cgs__make_gaussians(cgs__decoder *d) {
    uint32_t *cumulated = CGS__NEW(d, uint32_t, 9294);
    uint8_t document[9678], *at = document; /* in its layout, for the checksum */
    for (int i = 0; i < CGS__GAUSSIAN_COUNT; i++) {
        const double deviation = exp2(i / (double)CGS__SCALES_PER_OCTAVE - 5), unit = sqrt(0.5) / deviation;
        const int r = (int)ceil(5 * deviation) + 1;
        cgs__table *table = d->gaussian + i;
        uint32_t f[256] = {65536}; /* f(0), ..., f(r), f(escape) */
        for (int q = r + 1; q > 0; q--) {
            const double tail = erfc((q - 0.5) * unit), mass = q > r ? tail : (tail - erfc((q + 0.5) * unit)) / 2;
            f[q] = (uint32_t)floor(65536 * mass + 0.5);
            if (!f[q]) f[q] = 1;
            f[0] -= q > r ? f[q] : 2 * f[q];
            table->expected += q > r ? 0 : q * (int64_t)f[q];
        }
        *at++ = (uint8_t)r, *at++ = (uint8_t)(r >> 8);
        for (int q = 0; q <= r + 1; q++) *at++ = (uint8_t)f[q], *at++ = (uint8_t)(f[q] >> 8);
        table->lowest = -r, table->entries = 2 * r + 2, table->expected /= 8;
        table->cumulated = cumulated;
        for (int q = -r; q <= r + 1; q++, cumulated++) cumulated[1] = cumulated[0] + f[q < 0 ? -q : q];
        cumulated++;
    }
    d->section = "Gaussian tables";
    cgs__require(d, cgs__crc32(document, sizeof document) == 0xad3b4090u, "this machine computes others");
}

/* The other tables, which are far from where they would be rounded the other way, too. */
static void cgs__make_tables(cgs__decoder *d) {
    for (int x = 0; x < 4096; x++) d->squash[x] = (uint16_t)(65536 / (1 + exp((2048 - x) / 256.0)) + 0.5);
    for (int i = 0, x = 0; i < 4096; i++) {
        while (x < 4096 && d->squash[x] < 16 * i + 8) x++;
        d->stretch[i] = (int16_t)cgs__clamp(x - 2048, -2047, 2047);
    }
    for (int n = 0; n < 1024; n++) {
        d->rate[n] = (uint16_t)(655360 / (10 * n + 16));
        d->confidence[n] = (int16_t)(256 * n / (n + 3));
    }
    for (int i = 0; i <= 2 * CGS__LARGEST_TABLE_SHIFT; i++)
        d->ratio[i] = (int32_t)exp2(15 + (2 * (i - CGS__LARGEST_TABLE_SHIFT) - 1) / 24.0);
}

/* ---- streams */

/* How the tables of a stream follow what its rows show; inertia 0: they do not. */
typedef struct {
    int channels, inertia;
} cgs__rows;

static int cgs__entry(const cgs__table *table, uint32_t slot) {
    int low = 0, high = table->entries;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (table->cumulated[middle] <= slot) low = middle;
        else high = middle;
    }
    return low;
}

/* Symbols [first, end) of a stream, INT32_MIN for escapes; `index` becomes that of the tables that were used. */
static void cgs__read_chunk(cgs__fields *words, const cgs__table *tables, cgs__rows rows, uint8_t *index,
                            int32_t *symbols, uint64_t first, uint64_t end) {
    cgs__decoder *d = words->d;
    const int states = end - first < CGS__SINGLE_STATE_SYMBOLS ? 1 : 2;
    const int32_t *ratio = d->ratio + CGS__LARGEST_TABLE_SHIFT;
    uint64_t state[2];
    int64_t seen = 0, expected = 0;
    int shift = 0;
    for (int k = 0; k < states; k++) {
        state[k] = cgs__unsigned(words, 8);
        cgs__require(d, state[k] >> 31 && !(state[k] >> 63), "a state begins out of range");
    }
    for (uint64_t i = first; i < end; i++) {
        const int64_t e = tables[index[i]].expected, most = CGS__SIZE_CAP * e;
        uint64_t *x = state + ((i - first) % (unsigned)states);
        const uint32_t slot = (uint32_t)(*x & 65535);
        if (rows.inertia) {
            if (i == first || i % (unsigned)rows.channels == 0) {
                seen = expected = (int64_t)CGS__ONE * rows.inertia;
                shift = 0;
            }
            index[i] = (uint8_t)cgs__clamp(index[i] + shift, 0, CGS__GAUSSIAN_COUNT - 1);
        }
        const cgs__table *table = tables + index[i];
        const int j = cgs__entry(table, slot);
        *x = (table->cumulated[j + 1] - table->cumulated[j]) * (*x >> 16) + slot - table->cumulated[j];
        if (*x < (uint64_t)1 << 31) *x = *x << 32 | cgs__unsigned(words, 4);
        symbols[i] = j == table->entries - 1 ? INT32_MIN : table->lowest + j;
        if (!rows.inertia) continue;
        const int64_t size = cgs__size(symbols[i]) * CGS__ONE; /* that of an escape is above all others */
        seen += CGS__ONE * (size < most ? size : most) / (e + CGS__SIZE_OFFSET);
        expected += CGS__ONE * e / (e + CGS__SIZE_OFFSET);
        while (shift < CGS__LARGEST_TABLE_SHIFT && 32768 * seen >= expected * ratio[shift + 1]) shift++;
        while (shift > -CGS__LARGEST_TABLE_SHIFT && 32768 * seen < expected * ratio[shift]) shift--;
    }
    cgs__end(words);
    for (int k = 0; k < states; k++)
        cgs__require(d, state[k] == (uint64_t)1 << 31, "a state does not end where it began");
}

static void cgs__read_stream(cgs__fields *f, const cgs__table *tables, cgs__rows rows, uint8_t *index, int32_t *symbols,
                             uint64_t count) {
    const uint64_t chunks = (count + CGS__CHUNK_SYMBOLS - 1) / CGS__CHUNK_SYMBOLS;
    cgs__block *mark = f->d->blocks;
    uint64_t *bytes = CGS__NEW(f->d, uint64_t, chunks + 1);
    if (!count) return;
    for (uint64_t chunk = 0; chunk < chunks; chunk++) {
        const uint64_t left = count - chunk * CGS__CHUNK_SYMBOLS;
        const uint64_t size = left < CGS__CHUNK_SYMBOLS ? left : (uint64_t)CGS__CHUNK_SYMBOLS;
        bytes[chunk] = 4 * cgs__varint(f, 2, size / 2 + 5, "words of a chunk");
    }
    const uint64_t escape_bytes = cgs__varint(f, 0, CGS__MAX_ESCAPE_BYTES * count, "escape_bytes");
    for (uint64_t chunk = 0; chunk < chunks; chunk++) {
        const uint64_t first = chunk * CGS__CHUNK_SYMBOLS;
        cgs__fields words = cgs__part(f, bytes[chunk]);
        cgs__read_chunk(&words, tables, rows, index, symbols, first,
                        chunk + 1 < chunks ? first + CGS__CHUNK_SYMBOLS : count);
    }
    cgs__fields escapes = cgs__part(f, escape_bytes);
    for (uint64_t i = 0; i < count; i++) {
        const cgs__table *table = tables + index[i];
        if (symbols[i] != INT32_MIN) continue;
        int64_t v = (int64_t)cgs__raw_varint(&escapes, CGS__MAX_ESCAPE_BYTES);
        v = v & 1 ? table->lowest - 1 - (v - 1) / 2 : table->lowest + table->entries - 1 + v / 2;
        cgs__require(f->d, v >= INT32_MIN && v <= INT32_MAX, "a symbol has more than 32 bits");
        symbols[i] = (int32_t)v;
    }
    cgs__end(&escapes);
    f->d->blocks = cgs__release(f->d->blocks, mark);
}

/* ---- arrays of integers */

/* All arrays of a section, one behind the other, up to its end. */
static int32_t *cgs__read_arrays(cgs__fields *f, const uint32_t *sizes, int arrays) {
    const cgs__rows none = {1, 0};
    cgs__decoder *d = f->d;
    uint64_t count = 0, bits = 0, bit = 0;
    for (int a = 0; a < arrays; a++) count += sizes[a];
    int32_t *values = CGS__NEW(d, int32_t, count + 1), *value = values;
    cgs__block *mark = d->blocks;
    uint8_t *settings = CGS__NEW(d, uint8_t, arrays), *index = CGS__NEW(d, uint8_t, count + 1), *table = index;
    for (int a = 0; a < arrays; table += sizes[a++]) {
        memset(table, cgs__int(f, 1, 0, CGS__GAUSSIAN_COUNT - 1, "table of an array"), sizes[a]);
        settings[a] = (uint8_t)cgs__int(f, 1, 0, CGS__MAX_LOW_BITS, "low_bits");
        bits += (uint64_t)sizes[a] * settings[a];
    }
    cgs__fields stream = cgs__part(f, cgs__varint(f, 0, f->size - f->at, "stream_bytes"));
    cgs__read_stream(&stream, d->gaussian, none, index, values, count);
    cgs__end(&stream);
    const uint8_t *low_parts = cgs__take(f, (bits + 7) / 8);
    cgs__end(f);
    for (int a = 0; a < arrays; a++) {
        const int64_t unit = (int64_t)1 << settings[a];
        for (const int32_t *end = value + sizes[a]; value < end; value++) {
            int64_t low = 0;
            for (int k = 0; k < settings[a]; k++, bit++) low = low << 1 | (low_parts[bit / 8] >> (7 - bit % 8) & 1);
            low += *value * unit - unit / 2;
            cgs__require(d, low >= INT32_MIN && low <= INT32_MAX, "an element has more than 32 bits");
            *value = (int32_t)low;
        }
    }
    for (; bit % 8; bit++)
        cgs__require(d, !(low_parts[bit / 8] >> (7 - bit % 8) & 1), "a bit behind the last low part is not zero");
    d->blocks = cgs__release(d->blocks, mark);
    return values;
}

static void cgs__make_table(cgs__decoder *d, cgs__table *table, const int32_t *differences, uint32_t *cumulated) {
    static const uint64_t mantissas[] = {1024, 1116, 1217, 1327, 1448, 1579, 1722, 1878};
    const int m = table->entries;
    uint64_t w[CGS__MAX_HYPER_SYMBOLS + 1] = {0}, sum = 0, missing = 65536;
    int64_t level = 0, largest = -1;
    int first = 0;
    for (int j = 0; j < m; j++) {
        level = j == m - 1 ? differences[j] : level + differences[j];
        cgs__require(d, level >= 0 && level <= 127, "a level of a table");
        if (level > largest) largest = level, first = j;
        sum += w[j] = mantissas[level % 8] << (level >> 3);
    }
    for (int j = 0; j < m; j++) missing -= w[j] = 1 + w[j] * (uint64_t)(65536 - m) / sum;
    w[first] += missing;
    for (int j = 0; j < m; j++) cumulated[j + 1] = cumulated[j] + (uint32_t)w[j];
    table->cumulated = cumulated;
}

static void cgs__read_tables(cgs__decoder *d) {
    cgs__fields f = cgs__open(d, CGS__TABLES);
    uint32_t count = 0, entries = 0;
    for (int g = 0; g < d->scene->groups; g++)
        if (!d->scene->group[g].context) count += (uint32_t)cgs__width(d->scene, g);
    cgs__table *tables = CGS__NEW(d, cgs__table, count + 1);
    for (uint32_t i = 0; i < count; i++) {
        tables[i].entries = (int32_t)cgs__varint(&f, 2, CGS__MAX_HYPER_SYMBOLS + 1, "entries of a table");
        tables[i].lowest = (int32_t)cgs__signed(&f, 9, CGS__MAX_SYMBOL, "lowest symbol of a table");
        entries += (uint32_t)tables[i].entries;
    }
    uint32_t *cumulated = CGS__NEW(d, uint32_t, entries + count);
    cgs__block *mark = d->blocks;
    if (!count) cgs__end(&f);
    const int32_t *differences = count ? cgs__read_arrays(&f, &entries, 1) : NULL;
    for (uint32_t i = 0; i < count; differences += tables[i].entries, cumulated += tables[i++].entries + 1)
        cgs__make_table(d, tables + i, differences, cumulated);
    for (int g = 0; g < d->scene->groups; g++) {
        if (d->scene->group[g].context) continue;
        d->tables[g] = tables;
        tables += cgs__width(d->scene, g);
    }
    d->blocks = cgs__release(d->blocks, mark);
}

/* ---- networks */

static cgs__network *cgs__read_network_head(cgs__fields *f, int group) {
    const cgs_scene *s = f->d->scene;
    const cgs_group *g = s->group + group;
    const int inputs = cgs__inputs(s, group), with_rows = s->version >= CGS__FIRST_WITH_ROWS;
    cgs__network *n = CGS__NEW(f->d, cgs__network, 1);
    n->layers = (int)cgs__varint(f, 1, CGS__MAX_LAYERS, "layers");
    int flags = (int)cgs__unsigned(f, 1);
    cgs__require(f->d, !(flags & ~((n->layers > 1) | (with_rows && g->channels > 1) << 1)), "flags of a network");
    n->skip = flags & 1, n->has_chain = flags >> 1;
    for (int i = 0; i < n->layers; i++) {
        cgs__layer *layer = n->layer + i;
        const int is_last = i == n->layers - 1;
        layer->outputs = (int)cgs__varint(f, 1, CGS__MAX_LAYER_WIDTH, "width of a layer");
        layer->inputs = i ? layer[-1].outputs + (is_last && n->skip ? inputs : 0) : inputs;
        flags = (int)cgs__unsigned(f, 1);
        layer->shift = flags & 31, layer->adds = flags >> 6 & 1, layer->rectify = flags >> 7;
        cgs__require(f->d, layer->shift <= CGS__MAX_SHIFT && !(flags & 32), "flags of a layer");
        if (layer->adds)
            cgs__require(f->d, i && !is_last && layer->outputs == layer[-1].inputs, "a layer adds what it cannot");
        n->widest = cgs__most(n->widest, cgs__most(layer->inputs, layer->outputs));
        if (is_last) cgs__require(f->d, layer->outputs == 2 * cgs__width(s, group), "outputs of a network");
    }
    if (cgs__sees(s, group, group)) n->follow_shift = cgs__int(f, 1, 0, CGS__MAX_SHIFT, "follow_shift");
    if (with_rows) n->inertia = cgs__int(f, 1, 0, CGS__MAX_INERTIA, "inertia");
    return n;
}

/* The next `count` values, of sizes below a limit. */
static int32_t *cgs__next(cgs__decoder *d, int32_t **values, int64_t count, int64_t limit, const char *what) {
    int32_t *first = *values;
    for (; count; count--, ++*values) cgs__require(d, **values < limit && **values > -limit, what);
    return first;
}

static void cgs__read_networks(cgs__decoder *d, uint32_t anchors) {
    const cgs_scene *s = d->scene;
    cgs__fields f = cgs__open(d, CGS__NETWORKS);
    uint32_t sizes[CGS_MAX_GROUPS * (4 * CGS__MAX_LAYERS + 2)] = {0};
    uint64_t elements = 0, weights = 0;
    int arrays = 0;
    for (int g = 0; g < s->groups; g++) {
        const int channels = s->group[g].channels;
        if (!s->group[g].context) continue;
        d->network[g] = cgs__read_network_head(&f, g);
        for (int i = 0; i < d->network[g]->layers; i++) {
            const cgs__layer *layer = d->network[g]->layer + i;
            const uint32_t inputs = (uint32_t)layer->inputs, outputs = (uint32_t)layer->outputs, upper = (outputs + 1) / 2;
            weights += (uint64_t)inputs * outputs;
            elements += (uint64_t)(inputs + 1) * outputs;
            cgs__require(d, elements <= CGS__MAX_WEIGHTS, "too many weights");
            sizes[arrays++] = upper * inputs;
            sizes[arrays++] = (outputs - upper) * inputs;
            sizes[arrays++] = upper;
            sizes[arrays++] = outputs - upper;
        }
        if (cgs__sees(s, g, g)) elements += sizes[arrays++] = (uint32_t)channels;
        if (d->network[g]->has_chain) elements += sizes[arrays++] = (uint32_t)(channels * (channels - 1) / 2);
    }
    cgs__require(d, elements <= CGS__MAX_WEIGHTS, "too many weights");
    cgs__check(d, CGS__NETWORK_PRODUCTS, anchors * weights, "more products than the file's length allows");
    if (!arrays) cgs__end(&f);
    int32_t *values = arrays ? cgs__read_arrays(&f, sizes, arrays) : NULL;
    for (int g = 0; g < s->groups; g++) {
        cgs__network *n = d->network[g];
        const int channels = s->group[g].channels;
        for (int i = 0; n && i < n->layers; i++) { /* the halves of an array lie side by side */
            cgs__layer *layer = n->layer + i;
            const int64_t least_beyond = ((1 << 29) - 1) / layer->inputs + 1;
            layer->weight = cgs__next(d, &values, (int64_t)layer->inputs * layer->outputs, least_beyond, "a weight");
            layer->bias = cgs__next(d, &values, layer->outputs, (int64_t)1 << 31, "a bias");
        }
        if (n && cgs__sees(s, g, g)) n->follow = cgs__next(d, &values, channels, CGS__FOLLOW_LIMIT, "an element of follow");
        if (n && n->has_chain)
            n->chain = cgs__next(d, &values, channels * (channels - 1) / 2, CGS__CHAIN_LIMIT, "an element of chain");
    }
}

/* Outputs of a network for a row of inputs, which are clamped. scratch: [3, widest]. */
static const int32_t *cgs__evaluate(const cgs__network *n, int32_t *inputs, int32_t *scratch) {
    int32_t *before = scratch, *x = scratch + n->widest, *y = x + n->widest;
    const int count = n->layer[0].inputs;
    for (int k = 0; k < count; k++) x[k] = inputs[k] = cgs__activation(inputs[k]);
    for (int i = 0; i < n->layers; i++) {
        const cgs__layer *layer = n->layer + i;
        const int32_t *w = layer->weight;
        int32_t *swap = before;
        if (i && i == n->layers - 1 && n->skip)
            memcpy(x + layer->inputs - count, inputs, (size_t)count * sizeof *x);
        for (int o = 0; o < layer->outputs; o++) {
            int64_t sum = 0;
            for (int k = 0; k < layer->inputs; k++) sum += (int64_t)*w++ * x[k];
            if (layer->shift) sum = cgs__right(sum + ((int64_t)1 << (layer->shift - 1)), layer->shift);
            sum += layer->bias[o];
            if (layer->rectify && sum < 0) sum = cgs__right(sum, 6);
            y[o] = cgs__activation(sum);
            if (layer->adds) y[o] = cgs__activation((int64_t)y[o] + before[o]);
        }
        before = x, x = y, y = swap;
    }
    return x;
}

/* ---- prediction heads */

typedef struct {
    const char *name;
    int sees_view, outputs, blocks;
} cgs__head;
/* Of each layout, by its number in the file. */
static const int CGS__HEADS_OF[] = {4, 2, 2};
static const cgs__head CGS__LAYOUTS[][4] = {
    {{"translation", 0, 3, 1}, {"covariance", 0, 7, 1}, {"opacity", 1, 1, 1}, {"color", 1, 3, 2}},
    {{"geometry", 0, 10, 1}, {"appearance", 1, 4, 1}},
    {{"geometry", 0, 10, 0}, {"appearance", 1, 4, 0}}};
typedef char cgs__tensor_name[CGS__MAX_NAME_BYTES + 1];

static int cgs__has_residuals(const cgs_scene *s) {
    int found = 0;
    for (int g = 0; g < s->groups; g++) found |= s->group[g].role == CGS_RESIDUAL;
    return found;
}

/* Appends a tensor; 0 rows: a vector. */
static void cgs__expect_tensor(cgs_scene *s, cgs__tensor_name *names, const char *head, const char *name, int rows,
                               int columns) {
    cgs_tensor *t = s->tensor + s->tensors;
    t->rows = (uint32_t)(rows ? rows : 1), t->columns = (uint32_t)columns;
    snprintf(names[s->tensors++], sizeof *names, "%s%s", head, name);
}

/* The tensors of a scene in the order of version 5, and their names in earlier versions. */
static void cgs__expect_tensors(cgs_scene *s, cgs__tensor_name *names) {
    static const char *const outer[] = {".input_weight", ".input_bias", ".output_weight", ".output_bias", ".skip_weight"};
    static const char *const inner[] = {"weight1", "bias1", "weight2", "bias2"};
    const cgs__head *head = CGS__LAYOUTS[s->heads], *end = head + CGS__HEADS_OF[s->heads];
    for (; head < end; head++) {
        const int inputs = s->reference_dim + 4 * head->sees_view + s->residual_dim, o = head->outputs, h = s->width;
        const int rows[] = {inputs, 0, h, 0, inputs}, columns[] = {h, h, o, o, o};
        for (int k = 0; k < 5; k++) cgs__expect_tensor(s, names, head->name, outer[k], rows[k], columns[k]);
        for (int k = 0; k < 4 * head->blocks; k++) {
            char name[32];
            snprintf(name, sizeof name, ".blocks.%d.%s", k / 4, inner[k % 4]);
            cgs__expect_tensor(s, names, head->name, name, k % 2 ? 0 : h, h);
        }
    }
    if (!cgs__has_residuals(s)) cgs__expect_tensor(s, names, "residuals", "", s->coupled_primitives, s->residual_dim);
}

/* Before version 5: the place of the next tensor in the list, by its name, whose first bytes are those of the last one. */
static int cgs__read_named(cgs__fields *f, const cgs_scene *s, cgs__tensor_name *names, char *name) {
    const size_t before = strlen(name), shared = (size_t)cgs__varint(f, 0, before, "shared bytes of a name");
    const size_t rest = (size_t)cgs__varint(f, 0, CGS__MAX_NAME_BYTES - shared, "bytes of a name");
    const uint8_t *text = cgs__take(f, rest);
    int k = 0;
    cgs__require(f->d, shared == before || !rest || name[shared] != (char)*text, "a name shares too few bytes");
    memcpy(name + shared, text, rest);
    name[shared + rest] = 0;
    while (k < s->tensors && strcmp(names[k], name)) k++;
    cgs__require(f->d, k < s->tensors && *name && strlen(name) == shared + rest, "a tensor is not of the list");
    *names[k] = 0; /* each is there once */
    const int rank = strstr(name, "bias") ? 1 : 2;
    cgs__varint(f, (uint64_t)rank, (uint64_t)rank, "rank of a tensor");
    if (rank == 2) cgs__varint(f, s->tensor[k].rows, s->tensor[k].rows, "side of a tensor");
    cgs__varint(f, s->tensor[k].columns, s->tensor[k].columns, "side of a tensor");
    return k;
}

static void cgs__read_heads(cgs__decoder *d, uint32_t coupled) {
    cgs_scene *s = d->scene;
    cgs__fields f = cgs__open(d, CGS__HEADS);
    const int is_named = s->version < CGS__FIRST_WITH_ROWS;
    cgs__tensor_name names[CGS_MAX_TENSORS], name = "";
    int place[CGS_MAX_TENSORS];
    uint32_t sizes[CGS_MAX_TENSORS] = {0};
    uint64_t elements = 0;
    cgs__expect_tensors(s, names);
    if (is_named) cgs__varint(&f, (uint64_t)s->tensors, (uint64_t)s->tensors, "number of tensors");
    for (int i = 0; i < s->tensors; i++) {
        cgs_tensor *t = s->tensor + (place[i] = is_named ? cgs__read_named(&f, s, names, name) : i);
        t->exponent = (int)cgs__signed(&f, 9, CGS__MAX_EXPONENT, "exponent of a tensor");
        elements += sizes[i] = t->rows * t->columns;
    }
    cgs__require(d, elements <= CGS__MAX_WEIGHTS, "too many elements of tensors");
    cgs__check(d, CGS__HEAD_PRODUCTS, coupled * elements, "more products than the file's length allows");
    int32_t *values = cgs__read_arrays(&f, sizes, s->tensors);
    for (int i = 0; i < s->tensors; values += sizes[i++]) s->tensor[place[i]].values = values;
}

/* ---- arithmetic code */

typedef struct {
    cgs__decoder *d;
    const uint8_t *data;
    uint64_t size, position, low, high, code;
} cgs__coder;

static uint64_t cgs__next_byte(cgs__coder *c) {
    const uint64_t at = c->position++;
    return at < c->size ? c->data[at] : 0;
}

/* Of the fields' rest. */
static cgs__coder cgs__start(const cgs__fields *f) {
    cgs__coder c = {f->d, f->data + f->at, f->size - f->at, 0, 0, ((uint64_t)1 << 48) - 1, 0};
    for (int i = 0; i < 6; i++) c.code = c.code << 8 | cgs__next_byte(&c);
    return c;
}

static int cgs__decide(cgs__coder *c, uint32_t p1) {
    const uint64_t mask = ((uint64_t)1 << 48) - 1, split = c->low + ((c->high - c->low) >> 16) * p1;
    const int bit = c->code <= split;
    if (bit) c->high = split;
    else c->low = split + 1;
    while (c->low >> 40 == c->high >> 40) {
        c->low = c->low << 8 & mask;
        c->high = (c->high << 8 & mask) | 255;
        c->code = (c->code << 8 & mask) | cgs__next_byte(c);
    }
    return bit;
}

/* Goes behind the code, which is refused if it does not end as an encoder ends it. */
static void cgs__finish(cgs__coder *c, cgs__fields *f) {
    cgs__require(f->d, c->code == ((c->low >> 40) + 1) << 40, "the code does not end as an encoder ends it");
    cgs__take(f, c->position - 5);
}

/* States: a probability of 22 bits, then a count of 10. */
static uint32_t *cgs__new_states(cgs__decoder *d, uint32_t count) {
    uint32_t *states = CGS__NEW(d, uint32_t, count);
    for (uint32_t i = 0; i < count; i++) states[i] = (uint32_t)1 << 31;
    return states;
}

static void cgs__learn(const cgs__decoder *d, uint32_t *state, int bit, uint32_t limit) {
    const uint32_t n = *state & 1023;
    int64_t p = *state >> 10;
    p += cgs__right((((int64_t)bit << 22) - p) * d->rate[n], 16);
    *state = (uint32_t)p << 10 | (n + (n < limit));
}

static int cgs__decide_by(cgs__coder *c, uint32_t *state) {
    const int bit = cgs__decide(c, (uint32_t)cgs__clamp(*state >> 16, 20, 65516));
    cgs__learn(c->d, state, bit, 1000);
    return bit;
}

typedef struct {
    int inputs, limit, rate;
    uint32_t *states;    /* of all inputs, one behind the other */
    int64_t *weights;    /* [sets, inputs + 1] */
    int32_t *refinement; /* [refinements, 33] */
    uint32_t at[7];      /* the state of each input */
} cgs__mixer;

static cgs__mixer cgs__new_mixer(cgs__decoder *d, int inputs, uint32_t states, int sets, int refinements,
                                 int64_t initial, int limit, int rate) {
    cgs__mixer m = {inputs, limit, rate, cgs__new_states(d, states), CGS__NEW(d, int64_t, sets * (inputs + 1)),
                    CGS__NEW(d, int32_t, 33 * refinements), {0}};
    for (int i = 0; i < sets * (inputs + 1); i++) m.weights[i] = i % (inputs + 1) < inputs ? initial : 0;
    for (int i = 0; i < 33 * refinements; i++) m.refinement[i] = d->squash[cgs__least(128 * (i % 33), 4095)];
    return m;
}

static int cgs__mix(cgs__coder *c, cgs__mixer *m, int first, int second, int refine) {
    const cgs__decoder *d = c->d;
    int64_t *weights[2] = {m->weights + first * (m->inputs + 1), m->weights + second * (m->inputs + 1)};
    int64_t l[8], logit[2];
    for (int k = 0; k < m->inputs; k++) {
        const uint32_t state = m->states[m->at[k]];
        l[k] = cgs__right((int64_t)d->stretch[state >> 20] * d->confidence[state & 1023], 8);
    }
    l[m->inputs] = 256;
    for (int set = 0; set < 2; set++) {
        int64_t sum = 0;
        for (int k = 0; k <= m->inputs; k++) sum += weights[set][k] * l[k];
        logit[set] = cgs__clamp(cgs__right(sum, 16), -2047, 2047);
    }
    const int64_t mean = cgs__right(logit[0] + logit[1], 1) + 2048, share = 32 * mean % 4096;
    int32_t *r = m->refinement + 33 * refine + mean / 128;
    const int64_t p1 = (d->squash[mean] + ((r[0] * (4096 - share) + r[1] * share) >> 12)) >> 1;
    const int bit = cgs__decide(c, (uint32_t)cgs__clamp(p1, 20, 65516));
    const int64_t target = 65535 * (int64_t)bit;
    for (int set = 0; set < 2; set++) {
        const int64_t error = (target - d->squash[logit[set] + 2048]) * m->rate;
        for (int k = 0; k <= m->inputs; k++) weights[set][k] += cgs__right(l[k] * error + 32768, 16);
    }
    for (int k = 0; k < m->inputs; k++) cgs__learn(d, m->states + m->at[k], bit, (uint32_t)m->limit);
    r[0] += (int32_t)cgs__right((target - r[0]) * (4096 - share), 18);
    r[1] += (int32_t)cgs__right((target - r[1]) * share, 18);
    return bit;
}

/* ---- positions: the walk of the octree */

/* A node that waits, with references: the index of such a node, or -2 - index of a single anchor, or -1 for none. */
typedef struct {
    int32_t place[3], near[27], child[8];
    uint8_t siblings, index, children; /* sums of 2^i over occupied children i: of the parent, its own; its place there */
} cgs__node;

typedef struct {
    cgs__coder coder;
    cgs__mixer occupancy, single;
    uint32_t *direct;
    const cgs__node *nodes; /* of this step */
    int32_t *offsets;       /* [anchors, 3] in the order of the walk */
    uint32_t anchors, found, waiting;
    int depth;
    uint8_t grid[64]; /* the 4 x 4 x 4 cells around the node at hand: 0 empty, 1 occupied, 2 unknown */
} cgs__walk;

/* Which of the eight children of its node, `height` bits above the voxels, holds a single anchor. */
static int cgs__child_holding(const cgs__walk *w, int32_t reference, int height) {
    const int32_t *v = w->offsets - 3 * (ptrdiff_t)(reference + 2);
    return 4 * (v[0] >> height & 1) + 2 * (v[1] >> height & 1) + (v[2] >> height & 1);
}

static int cgs__cell(int c) { return 21 + 16 * (c >> 2) + 4 * (c >> 1 & 1) + (c & 1); }

/* The children of the node itself, which are later than all that is known, are unknown as yet. */
static void cgs__look_around(cgs__walk *w, int32_t node, int height) {
    for (int cell = 0; cell < 64; cell++) {
        const int x = (cell >> 4) + 1, y = (cell >> 2 & 3) + 1, z = (cell & 3) + 1;
        const int32_t reference = w->nodes[node].near[9 * (x >> 1) + 3 * (y >> 1) + (z >> 1)];
        const int c = 4 * (x & 1) + 2 * (y & 1) + (z & 1);
        w->grid[cell] = reference >= node ? 2 : reference >= 0 ? w->nodes[reference].children >> c & 1
                      : reference < -1 && cgs__child_holding(w, reference, height) == c;
    }
}

/* How many of the 26 cells around one have a state. */
static int cgs__count(const cgs__walk *w, int cell, int state, int most) {
    const uint8_t *at = w->grid + cell - 21;
    int count = -(w->grid[cell] == state);
    for (int x = 0; x < 48; x += 16)
        for (int y = 0; y < 12; y += 4) count += (at[x + y] == state) + (at[x + y + 1] == state) + (at[x + y + 2] == state);
    return cgs__least(count, most);
}

/* The states of the cells on both sides along an axis, as digits to base 3. */
static int cgs__sides(const cgs__walk *w, int cell, int axis) {
    return 3 * w->grid[cell - (16 >> 2 * axis)] + w->grid[cell + (16 >> 2 * axis)];
}

static int cgs__read_occupancy(cgs__walk *w, const cgs__node *n, int step) {
    static const uint32_t base[7] = {0, 8192, 37352, 42472, 43772, 54524, 70908};
    static const int unit[3] = {9, 3, 1};
    const int height = w->depth - 1 - step, siblings = cgs__ones(n->siblings) - 1;
    const int bits = n->place[0] | n->place[1] | n->place[2];
    const int grid = (height < 3 && !(bits & ((1 << (3 - height)) - 1))) + 2 * (height == 0 && !(bits & 1));
    const int scale_grid = 4 * cgs__least(height, 7) + grid;
    uint32_t *at = w->occupancy.at;
    int face_nodes = 0, children = 0, taken = 0;
    for (int k = 0; k < 6; k++) face_nodes |= (n->near[13 + (k % 2 ? unit[k / 2] : -unit[k / 2])] != -1) << k;
    for (int c = 0; c < 8; c++) {
        const int cell = cgs__cell(c), few = cgs__least(taken, 4), prefix = (1 << c) + children;
        const int occupied = cgs__count(w, cell, 1, 12), open = cgs__count(w, cell, 2, 19);
        int faces = 0, touching = 0, bit = 1;
        if (taken + 8 - c > (height ? 1 : 2)) {
            for (int axis = 0; axis < 3; axis++) faces = 9 * faces + cgs__sides(w, cell, axis);
            for (int part = 1; part < 8; part++) { /* of the axes, the first in the highest bit */
                int node = 13;
                for (int axis = 0; axis < 3; axis++)
                    if (part >> (2 - axis) & 1) node += c >> (2 - axis) & 1 ? unit[axis] : -unit[axis];
                touching |= (n->near[node] != -1) << (part - 1);
            }
            at[0] = base[0] + (uint32_t)(256 * scale_grid + prefix);
            at[1] = base[1] + (uint32_t)((8 * faces + c) * 5 + few);
            at[2] = base[2] + (uint32_t)((8 * touching + c) * 5 + few);
            at[3] = base[3] + (uint32_t)((20 * occupied + open) * 5 + few);
            at[4] = base[4] + (uint32_t)(((8 * step + siblings) * 8 + c) * 8 + taken);
            at[5] = base[5] + (uint32_t)(256 * face_nodes + prefix);
            at[6] = base[6] + (uint32_t)((8 * n->siblings + n->index) * 8 + c);
            bit = cgs__mix(&w->coder, &w->occupancy, 8 * step + c, 168 + 5 * occupied + few, 8 * scale_grid + c);
        }
        w->grid[cell] = (uint8_t)bit;
        children |= bit << c;
        taken += bit;
    }
    return children;
}

/* The last `bits` bits per axis of an anchor that is alone in its node. */
static void cgs__read_single(cgs__walk *w, int32_t x, int32_t y, int32_t z, int bits, const int sides[3]) {
    int32_t *v = w->offsets + 3 * (size_t)w->found++;
    const int low = cgs__least(bits, 4);
    int zeros = 1, coarse = 0;
    v[0] = x, v[1] = y, v[2] = z;
    for (int b = bits - 1; b >= 4; b--) {
        for (int axis = 0; axis < 3; axis++) {
            const int state = b == bits - 1 ? 3 * sides[axis] : 27 + 3 * (2 * sides[axis] + (v[axis] & 1));
            const int bit = b >= bits - 2 ? cgs__decide_by(&w->coder, w->direct + state + axis) : cgs__decide(&w->coder, 32768);
            v[axis] = 2 * v[axis] + bit;
        }
    }
    for (int axis = 0; axis < 3; axis++) v[axis] <<= low;
    for (int half = 0; half < 2; half++, coarse = zeros) {
        for (int axis = 0; axis < 3; axis++) {
            for (int b = cgs__least(low, 2 * half + 2) - 1; b >= 2 * half; b--) {
                const int state = ((((half * 3 + axis) * 2 + b % 2) * 2 + zeros) * 2 + coarse) * 5 + low;
                const int bit = cgs__decide_by(&w->coder, w->direct + 128 + state);
                v[axis] |= bit << b;
                zeros &= !bit;
            }
        }
    }
}

static void cgs__read_singles(cgs__walk *w, cgs__node *n, int step) {
    static const uint32_t base[5] = {0, 1344, 2384, 5300, 7348};
    const int height = w->depth - 1 - step, children = n->children, taken = cgs__ones(children);
    uint32_t *at = w->single.at;
    int neighbours = -1, crowds = -1, crowd = 0; /* without the node itself */
    for (int j = 0; j < 27; j++) {
        neighbours += n->near[j] != -1;
        crowds += n->near[j] >= 0;
    }
    for (int c = 0; c < 8; c++) {
        const int cell = cgs__cell(c);
        int is_single = height == 0, sides[3];
        n->child[c] = -1;
        if (!(children >> c & 1)) continue;
        if (height > 0 && taken > 1) {
            const int occupied = cgs__count(w, cell, 1, 12), open = cgs__count(w, cell, 2, 19);
            const int three = cgs__least(taken, 3), last = !(children >> (c + 1));
            at[0] = base[0] + (uint32_t)((8 * step + taken - 1) * 8 + 2 * crowd + last);
            at[1] = base[1] + (uint32_t)((20 * occupied + open) * 4 + three);
            at[2] = base[2] + (uint32_t)((27 * neighbours + crowds) * 4 + three);
            at[3] = base[3] + (uint32_t)(8 * children + c);
            at[4] = base[4] + (uint32_t)((13 * crowds + occupied) * 8 + taken - 1);
            is_single = cgs__mix(&w->coder, &w->single, 8 * step + taken - 1, 168 + 20 * occupied + open, 4 * step + crowd);
        }
        if (!is_single) {
            crowd = cgs__least(crowd + 1, 3);
            n->child[c] = (int32_t)w->waiting++;
            continue;
        }
        cgs__require(w->coder.d, w->found < w->anchors, "more anchors than the scene has");
        n->child[c] = -2 - (int32_t)w->found;
        for (int axis = 0; axis < 3; axis++) sides[axis] = cgs__sides(w, cell, axis);
        cgs__read_single(w, 2 * n->place[0] + (c >> 2), 2 * n->place[1] + (c >> 1 & 1), 2 * n->place[2] + (c & 1), height,
                         sides);
    }
}

/* A child of a node, as it waits for the next step. */
static cgs__node cgs__next_node(const cgs__walk *w, const cgs__node *n, int c, int height) {
    cgs__node next = {{0}, {0}, {0}, n->children, (uint8_t)c, 0};
    for (int axis = 0; axis < 3; axis++) next.place[axis] = 2 * n->place[axis] + (c >> (2 - axis) & 1);
    for (int j = 0; j < 27; j++) {
        const int x = (c >> 2) + j / 9 + 1, y = (c >> 1 & 1) + j / 3 % 3 + 1, z = (c & 1) + j % 3 + 1; /* 1 ... 4 */
        const int32_t reference = n->near[9 * (x >> 1) + 3 * (y >> 1) + (z >> 1)];
        const int child = 4 * (x & 1) + 2 * (y & 1) + (z & 1);
        next.near[j] = reference >= 0 ? w->nodes[reference].child[child]
                     : reference < -1 && cgs__child_holding(w, reference, height) == child ? reference : -1;
    }
    return next;
}

/* Reads the nodes of a step, and makes those of the next. */
static void cgs__walk_step(cgs__walk *w, cgs__node *nodes, cgs__node *next, int step) {
    const uint32_t count = w->waiting;
    const int height = w->depth - 1 - step;
    w->nodes = nodes;
    w->waiting = 0;
    for (uint32_t node = 0; node < count; node++) {
        cgs__look_around(w, (int32_t)node, height);
        nodes[node].children = (uint8_t)cgs__read_occupancy(w, nodes + node, step);
        cgs__read_singles(w, nodes + node, step);
        cgs__require(w->coder.d, w->found + 2 * ((uint64_t)w->waiting + count - 1 - node) <= w->anchors,
                     "more anchors than the scene has");
    }
    for (uint32_t node = 0; node < count; node++)
        for (int c = 0; c < 8; c++)
            if (nodes[node].child[c] >= 0) *next++ = cgs__next_node(w, nodes + node, c, height);
}

/* Offsets [anchors, 3] in the order of the walk. */
static int32_t *cgs__read_walk(cgs__fields *f, uint32_t anchors, int depth) {
    static const int nowhere[3] = {0, 0, 0};
    cgs__decoder *d = f->d;
    int32_t *offsets = CGS__NEW(d, int32_t, 3 * (uint64_t)anchors);
    cgs__block *mark = d->blocks;
    cgs__walk w;
    memset(&w, 0, sizeof w);
    w.coder = cgs__start(f), w.offsets = offsets, w.anchors = anchors, w.depth = depth;
    w.direct = cgs__new_states(d, 368);
    if (anchors == 1) {
        cgs__read_single(&w, 0, 0, 0, depth, nowhere);
    } else {
        /* Each node that waits holds at least two anchors. */
        cgs__node *nodes[2] = {CGS__NEW(d, cgs__node, anchors / 2), CGS__NEW(d, cgs__node, anchors / 2)};
        uint64_t count = 0;
        w.occupancy = cgs__new_mixer(d, 7, 87292, 168 + 65, 256, 16384, 400, 4);
        w.single = cgs__new_mixer(d, 5, 10156, 168 + 260, 84, 16384, 400, 4);
        memset(nodes[0]->near, 0xff, sizeof nodes[0]->near);
        nodes[0]->near[13] = 0;
        nodes[0]->siblings = 1;
        w.waiting = 1;
        for (int step = 0; step < depth && w.waiting; step++) {
            count += w.waiting;
            cgs__check(d, CGS__NODES, count, "more nodes than the file's length allows");
            cgs__walk_step(&w, nodes[step % 2], nodes[1 - step % 2], step);
        }
    }
    cgs__require(d, w.found == anchors, "fewer anchors than the scene has");
    cgs__finish(&w.coder, f);
    d->blocks = cgs__release(d->blocks, mark);
    return offsets;
}

static uint64_t cgs__morton(const int32_t *v) {
    uint64_t code = 0;
    for (int b = CGS__MAX_DEPTH - 1; b >= 0; b--)
        for (int axis = 0; axis < 3; axis++) code = code << 1 | (uint64_t)(v[axis] >> b & 1);
    return code;
}

static int cgs__by_code(const void *a, const void *b) {
    const uint64_t x = *(const uint64_t *)a, y = *(const uint64_t *)b;
    return x < y ? -1 : x > y;
}

/* Brings the offsets into canonical order, and counts the anchors of each level and those above it. */
static void cgs__order(cgs__decoder *d, uint32_t anchors, int depth) {
    cgs__block *mark = d->blocks;
    uint64_t *codes = CGS__NEW(d, uint64_t, anchors);
    uint8_t *levels = CGS__NEW(d, uint8_t, anchors);
    uint32_t next[CGS__MAX_DEPTH + 2] = {0};
    for (uint32_t i = 0; i < anchors; i++) codes[i] = cgs__morton(d->offsets + 3 * (size_t)i);
    qsort(codes, anchors, sizeof *codes, cgs__by_code);
    for (uint32_t i = 0; i < anchors; i++) {
        int level = i ? depth + 1 : 0;
        for (uint64_t differs = i ? codes[i] ^ codes[i - 1] : 0; differs; differs >>= 3) level--;
        cgs__require(d, level <= depth, "two anchors are in one place"); /* no walk gives that */
        levels[i] = (uint8_t)level;
        next[level + 1]++;
    }
    for (int level = 0; level <= depth; level++) d->up_to_level[level] = next[level + 1] += next[level];
    for (uint32_t i = 0; i < anchors; i++) {
        int32_t *v = d->offsets + 3 * (size_t)next[levels[i]]++;
        v[0] = v[1] = v[2] = 0;
        for (int b = 3 * CGS__MAX_DEPTH - 1; b >= 0; b--) v[2 - b % 3] = v[2 - b % 3] << 1 | (int32_t)(codes[i] >> b & 1);
    }
    d->blocks = cgs__release(d->blocks, mark);
}

static void cgs__read_positions(cgs__decoder *d) {
    cgs_scene *s = d->scene;
    const uint32_t anchors = s->total_anchors, least = (anchors + 3) / 4;
    int32_t smallest[3] = {INT32_MAX, INT32_MAX, INT32_MAX}, largest[3] = {0};
    int64_t origin[3];
    cgs__fields f = cgs__open(d, CGS__GPCC);
    if (f.data) cgs__fail(d, CGS_MISSING_DEPENDENCY, "this decoder has no G-PCC");
    f = cgs__open(d, CGS__POSITIONS);
    cgs__require(d, f.size >= least, "too few bytes for so many anchors");
    s->depth = cgs__int(&f, 1, 0, CGS__MAX_DEPTH, "depth");
    cgs__require(d, anchors <= (uint64_t)1 << (3 * s->depth), "more anchors than the octree has room for");
    for (int axis = 0; axis < 3; axis++) origin[axis] = 16 * cgs__signed(&f, 4, (int64_t)1 << 27, "origin");
    d->offsets = cgs__read_walk(&f, anchors, s->depth);
    cgs__require(d, f.at == f.size || f.size == least, "bytes are left over");
    while (f.at < f.size) cgs__require(d, !*cgs__take(&f, 1), "a byte behind the code is not zero");
    for (uint32_t i = 0; i < 3 * anchors; i++) {
        if (d->offsets[i] < smallest[i % 3]) smallest[i % 3] = d->offsets[i];
        if (d->offsets[i] > largest[i % 3]) largest[i % 3] = d->offsets[i];
    }
    cgs__require(d, s->depth == 0 || (largest[0] | largest[1] | largest[2]) >> (s->depth - 1) == 1,
                 "depth is not that of the anchors");
    for (int axis = 0; axis < 3; axis++) {
        cgs__require(d, smallest[axis] < 16, "origin is not that of the anchors");
        cgs__require(d, origin[axis] >= INT32_MIN && origin[axis] + largest[axis] <= INT32_MAX,
                     "coordinates beyond 32 bits");
    }
    cgs__order(d, anchors, s->depth);
    s->coordinates = CGS__NEW(d, int32_t, 3 * (uint64_t)anchors);
    for (uint32_t i = 0; i < 3 * anchors; i++) s->coordinates[i] = (int32_t)(origin[i % 3] + d->offsets[i]);
}

/* ---- masks */

static void cgs__read_masks(cgs__decoder *d) {
    const uint32_t anchors = d->scene->total_anchors, slots = (uint32_t)d->scene->coupled_primitives;
    const uint64_t flags = (uint64_t)anchors * slots;
    cgs__fields f = cgs__open(d, CGS__MASKS);
    uint8_t *mask = d->mask = CGS__NEW(d, uint8_t, flags);
    cgs__block *mark = d->blocks;
    cgs__mixer mixer = cgs__new_mixer(d, 3, 4160 + 16384 + 16640, 64 + 4, 64, 24576, 1000, 2);
    cgs__coder coder = cgs__start(&f);
    uint64_t exist = f.size ? 0 : flags;
    uint32_t before = 0;
    if (!f.size) memset(mask, 1, (size_t)flags);
    for (uint32_t i = 0; f.size && i < anchors; i++, mask += slots) {
        uint32_t taken = 0, recent = 0;
        for (uint32_t k = 0; k < slots; k++) {
            const uint32_t one = i > 0 ? (mask - slots)[k] : 0, two = i > 1 ? (mask - 2 * (size_t)slots)[k] : 0;
            mixer.at[0] = 65 * k + taken;
            mixer.at[1] = 4160 + 256 * k + recent;
            mixer.at[2] = 4160 + 16384 + (4 * k + 2 * one + two) * 65 + before;
            mask[k] = (uint8_t)cgs__mix(&coder, &mixer, (int)k, (int)(64 + 2 * one + two), (int)k);
            taken += mask[k];
            recent = (2 * recent + mask[k]) & 255;
        }
        before = taken;
        exist += taken;
    }
    if (f.size) {
        cgs__finish(&coder, &f);
        cgs__end(&f);
        cgs__require(d, exist < flags, "masks of ones are written out");
    }
    cgs__require(d, exist == d->promised_coupled, "another number of coupled primitives than the scene has");
    d->blocks = cgs__release(d->blocks, mark);
}

/* ---- latents */

typedef struct {
    uint64_t code;
    uint32_t anchor;
} cgs__place;

typedef struct {
    cgs__fields fields;
    int level, earlier_level;
    uint32_t first, count, coupled, primitive;
} cgs__range;

/* What an anchor's neighbours, at most 27 of earlier ranges, have of a group: known, activity, around of each channel. */
static void cgs__what_is_around(const cgs__decoder *d, int group, const cgs__place *places, uint32_t count, int shift,
                                uint32_t anchor, int64_t *said) {
    const cgs_group *g = d->scene->group + group;
    const cgs__network *n = d->network[group];
    const int32_t *bias = n->layer[n->layers - 1].bias, *own = d->offsets + 3 * (size_t)anchor;
    int64_t total = 0;
    memset(said, 0, (2 + (size_t)g->channels) * sizeof *said);
    for (int j = 0; j < 27; j++) {
        const int32_t node[3] = {(own[0] >> shift) + j / 9 - 1, (own[1] >> shift) + j / 3 % 3 - 1,
                                 (own[2] >> shift) + j % 3 - 1};
        if ((node[0] | node[1] | node[2]) >> CGS__MAX_DEPTH) continue; /* outside, also where negative */
        const cgs__place key = {cgs__morton(node), 0};
        const cgs__place *found = (const cgs__place *)bsearch(&key, places, count, sizeof key, cgs__by_code);
        int64_t distance = 0, sizes = 0;
        if (!found) continue;
        for (int axis = 0; axis < 3; axis++) distance += cgs__size(own[axis] - d->offsets[3 * (size_t)found->anchor + axis]);
        const int64_t weight = 1 + ((int64_t)1 << 24) / distance; /* anchors are in different places */
        for (int c = 0; c < g->channels; c++) {
            const int64_t x = g->latents[found->anchor * (size_t)g->channels + c], differs = cgs__activation(x - bias[c]);
            said[2 + c] += weight * differs;
            sizes += cgs__size(differs);
        }
        said[1] += weight * (sizes / g->channels);
        total += weight;
    }
    if (!total) return; /* never: their nodes are all those of the level */
    said[0] = CGS__ONE;
    said[1] /= total;
    for (int c = 0; c < g->channels; c++) said[2 + c] = cgs__floor_div(said[2 + c], total);
}

/* Means and tables of the symbols of a range's group, in the order of its stream. */
static void cgs__expect(cgs__decoder *d, int group, const cgs__range *range, int32_t *means, uint8_t *index) {
    const cgs_scene *s = d->scene;
    const cgs_group *g = s->group + group;
    const cgs__network *n = d->network[group];
    const int width = cgs__width(s, group), sees = cgs__sees(s, group, group);
    const int shift = s->depth - range->earlier_level;
    const uint32_t known = sees ? range->first : 0;
    int32_t *scratch = CGS__NEW(d, int32_t, 3 * (uint64_t)n->widest), *inputs = CGS__NEW(d, int32_t, cgs__inputs(s, group));
    int64_t *said = CGS__NEW(d, int64_t, 2 + g->channels);
    cgs__place *places = CGS__NEW(d, cgs__place, known);
    const int32_t *bias = n->layer[n->layers - 1].bias;
    for (uint32_t i = 0; i < known; i++) {
        places[i].code = cgs__morton(d->offsets + 3 * (size_t)i) >> (3 * shift);
        places[i].anchor = i;
    }
    qsort(places, known, sizeof *places, cgs__by_code);
    for (uint32_t anchor = range->first; anchor < range->first + range->count; anchor++) {
        const uint8_t *exists = d->mask + anchor * (size_t)s->coupled_primitives;
        const int32_t *out, *offset = d->offsets + 3 * (size_t)anchor;
        int at = 0;
        for (; at < 3 && g->context & 1; at++)
            inputs[at] = (int32_t)((((2 * (int64_t)offset[at] + 1) << 12) >> s->depth) - CGS__ONE);
        for (int j = 0; j < group; j++) {
            const size_t channels = (size_t)s->group[j].channels;
            if (!cgs__sees(s, group, j)) continue;
            memcpy(inputs + at, s->group[j].latents + anchor * channels, channels * sizeof *inputs);
            at += (int)channels;
        }
        if (known) cgs__what_is_around(d, group, places, known, shift, anchor, said);
        if (sees) inputs[at++] = (int32_t)said[0], inputs[at++] = (int32_t)said[1];
        out = cgs__evaluate(n, inputs, scratch);
        for (int c = 0; c < width; c++) {
            int64_t mean = out[c];
            if (g->role == CGS_RESIDUAL && !exists[c / g->channels]) continue;
            if (sees) {
                const int64_t half = n->follow_shift ? (int64_t)1 << (n->follow_shift - 1) : 0;
                mean += cgs__right(n->follow[c] * said[2 + c] + half, n->follow_shift) - bias[c];
                mean = cgs__activation(bias[c] + cgs__right(mean + 2048, 12) * CGS__ONE);
            }
            *means++ = (int32_t)mean;
            *index++ = (uint8_t)cgs__clamp(cgs__right((int64_t)out[width + c] + 2048, 12), 0, CGS__GAUSSIAN_COUNT - 1);
        }
    }
}

static void cgs__read_group_latents(cgs__decoder *d, int group, cgs__range *range) {
    cgs_scene *s = d->scene;
    cgs_group *g = s->group + group;
    const cgs__network *n = d->network[group];
    const int is_residual = g->role == CGS_RESIDUAL, slots = is_residual ? s->coupled_primitives : 1;
    const size_t channels = (size_t)g->channels, rows = is_residual ? range->coupled : range->count, count = rows * channels;
    const cgs__rows how = {g->channels, n ? n->inertia : 0};
    cgs__block *mark = d->blocks;
    int32_t *means = CGS__NEW(d, int32_t, count + 1), *row = CGS__NEW(d, int32_t, count + 1);
    uint8_t *index = CGS__NEW(d, uint8_t, count + 1), *table = index;
    int32_t *latents = g->latents + (is_residual ? range->primitive : range->first) * channels;
    int32_t *symbols = g->symbols + range->first * channels * (size_t)slots;
    const uint8_t *exists = d->mask + range->first * (size_t)s->coupled_primitives;
    if (n) cgs__expect(d, group, range, means, index);
    for (size_t i = 0; !n && i < (size_t)range->count * (unsigned)slots; i++)
        for (int c = 0; c < g->channels && (!is_residual || exists[i]); c++)
            *table++ = (uint8_t)(i % (unsigned)slots * channels + c);
    cgs__read_stream(&range->fields, n ? d->gaussian : d->tables[group], how, index, row, count);
    for (size_t i = 0; i < (size_t)range->count * (unsigned)slots; i++, symbols += channels) {
        const int32_t *weight = n ? n->chain : NULL;
        if (is_residual && !exists[i]) continue;
        for (int c = 0; c < g->channels; c++) { /* symbols become steps, the earlier ones of a row first */
            int64_t sum = 32;
            symbols[c] = row[c];
            cgs__require(d, cgs__size(row[c]) <= CGS__MAX_SYMBOL, "a symbol beyond MAX_SYMBOL");
            for (int j = 0; weight && j < c; j++) sum += (int64_t)*weight++ * row[j];
            sum = row[c] + cgs__right(sum, 6);
            cgs__require(d, cgs__size(sum) <= CGS__MAX_SYMBOL, "a step beyond MAX_SYMBOL");
            row[c] = (int32_t)sum;
            *latents++ = row[c] * CGS__ONE + *means++;
        }
        row += channels;
    }
    d->blocks = cgs__release(d->blocks, mark);
}

/* Heads of the ranges that are there; how many. */
static int cgs__read_range_heads(cgs__decoder *d, cgs__range *ranges) {
    cgs__range *range = ranges;
    uint32_t first = 0, primitive = 0;
    d->section = cgs__name(CGS__LATENTS);
    for (int i = 0; i < d->sections; i++) {
        if (d->number[i] != CGS__LATENTS) continue;
        range->fields = d->section_of[i];
        range->first = first, range->primitive = primitive;
        range->level = (int)cgs__varint(&range->fields, 0, CGS__MAX_DEPTH, "level");
        range->earlier_level = range > ranges ? range[-1].level : 0;
        first += range->count = (uint32_t)cgs__varint(&range->fields, 1, CGS__MAX_ANCHORS, "range_anchors");
        primitive += range->coupled = (uint32_t)cgs__varint(&range->fields, 0, 64 * range->count, "range_coupled");
        range++;
    }
    return (int)(range - ranges);
}

static void cgs__read_latents(cgs__decoder *d, cgs__range *ranges, int count) {
    cgs_scene *s = d->scene;
    const uint8_t *exists = d->mask;
    d->section = cgs__name(CGS__LATENTS);
    for (cgs__range *r = ranges; r < ranges + count; r++) {
        uint32_t coupled = 0;
        cgs__require(d, r->level <= s->depth && (r == ranges || r->level > r->earlier_level), "level of a range");
        cgs__require(d, r->first + (uint64_t)r->count == d->up_to_level[r->level], "range_anchors");
        for (size_t i = 0; i < r->count * (size_t)s->coupled_primitives; i++) coupled += *exists++;
        cgs__require(d, r->coupled == coupled, "range_coupled");
    }
    cgs__require(d, !d->whole || ranges[count - 1].level == s->depth, "level of the last range");
    for (int g = 0; g < s->groups; g++) {
        cgs_group *group = s->group + g;
        group->rows = group->role == CGS_RESIDUAL ? s->coupled : s->anchors;
        group->latents = CGS__NEW(d, int32_t, (uint64_t)group->rows * (unsigned)group->channels + 1);
        group->symbols = CGS__NEW(d, int32_t, (uint64_t)s->anchors * (unsigned)cgs__width(s, g) + 1);
    }
    for (cgs__range *r = ranges; r < ranges + count; r++) {
        for (int g = 0; g < s->groups; g++) cgs__read_group_latents(d, g, r);
        cgs__end(&r->fields);
    }
}

/* ---- optional sections */

static void cgs__check_metadata(cgs__decoder *d) {
    cgs__fields f = cgs__open(d, CGS__METADATA);
    const uint8_t *before = NULL;
    size_t before_size = 0;
    if (!f.data) return;
    cgs__require(d, f.size <= CGS__MAX_METADATA_BYTES, "too many bytes");
    for (uint64_t entries = cgs__varint(&f, 0, CGS__MAX_METADATA_BYTES, "entries"); entries; entries--) {
        const size_t size = (size_t)cgs__varint(&f, 0, CGS__MAX_METADATA_BYTES, "length of a key");
        const uint8_t *key = f.data + f.at;
        int order = -1;
        cgs__skip_text(&f, size);
        if (before) order = memcmp(before, key, before_size < size ? before_size : size);
        cgs__require(d, order < 0 || (order == 0 && before_size < size), "keys are not in order");
        before = key, before_size = size;
        cgs__skip_text(&f, cgs__varint(&f, 0, CGS__MAX_METADATA_BYTES, "length of a value"));
    }
    cgs__end(&f);
}

static void cgs__read_rotation(cgs__fields *f, double rotation[4]) {
    const uint64_t packed = cgs__unsigned(f, 6);
    const int largest = (int)(packed & 3);
    int64_t squares = 0;
    double rest = 1;
    cgs__require(f->d, !(packed >> 47), "bit 47 of a rotation");
    for (int i = 0, at = largest == 0; i < 3; i++, at += at + 1 == largest ? 2 : 1) {
        const int raw = (int)(packed >> (2 + 15 * i) & 32767), value = raw < 16384 ? raw : raw - 32768;
        cgs__require(f->d, value > -16384, "a rotation");
        squares += (int64_t)value * value;
        rotation[at] = value / (16383 * sqrt(2.0));
        rest -= rotation[at] * rotation[at];
    }
    cgs__require(f->d, squares <= (int64_t)3 << 27, "a rotation");
    rotation[largest] = sqrt(rest);
}

static void cgs__read_viewpoints(cgs__decoder *d) {
    cgs_scene *s = d->scene;
    cgs__fields f = cgs__open(d, CGS__VIEWPOINTS);
    cgs_view lens[16];
    double center[3];
    if (!f.data) return;
    for (int i = 0; i < 3; i++) {
        s->up[i] = (int8_t)cgs__unsigned(&f, 1);
        cgs__require(d, s->up[i] >= -127, "up");
    }
    const double norm = sqrt(s->up[0] * s->up[0] + s->up[1] * s->up[1] + s->up[2] * s->up[2]);
    cgs__require(d, norm > 0, "up is no direction");
    for (int i = 0; i < 3; i++) s->up[i] /= norm;
    for (int i = 0; i < 3; i++) center[i] = cgs__real(&f, 4, -FLT_MAX, FLT_MAX, "centre");
    const double radius = cgs__length(&f);
    const int lenses = cgs__int(&f, 1, 1, 16, "lenses");
    memset(lens, 0, sizeof lens);
    for (int i = 0; i < lenses; i++) {
        lens[i].width = cgs__int(&f, 2, 1, 65535, "width of an image");
        lens[i].height = cgs__int(&f, 2, 1, 65535, "height of an image");
        lens[i].fx = cgs__length(&f);
        lens[i].fy = cgs__length(&f);
    }
    s->views = cgs__int(&f, 1, 1, 255, "views");
    s->view = CGS__NEW(d, cgs_view, s->views);
    for (int i = 0; i < s->views; i++) {
        s->view[i] = lens[cgs__int(&f, 1, 0, lenses - 1, "lens of a view")];
        for (int k = 0; k < 3; k++) {
            const int place = (int16_t)cgs__unsigned(&f, 2);
            cgs__require(d, place >= -32767, "position of a view");
            s->view[i].position[k] = center[k] + radius * place / 32767;
        }
        cgs__read_rotation(&f, s->view[i].rotation);
    }
    cgs__end(&f);
}

/* ---- the whole */

static void cgs__decode_all(cgs__decoder *d) {
    cgs_scene *s = d->scene;
    cgs__range ranges[CGS__MAX_RANGES];
    uint64_t width = 0;
    cgs__unpack(d);
    cgs__read_scene(d);
    const int count = cgs__read_range_heads(d, ranges);
    s->anchors = s->total_anchors, s->coupled = d->promised_coupled;
    if (d->prefix) {
        s->anchors = ranges[count - 1].first + ranges[count - 1].count;
        s->coupled = ranges[count - 1].primitive + ranges[count - 1].coupled;
    }
    for (int g = 0; g < s->groups; g++) width += (unsigned)cgs__width(s, g);
    d->section = cgs__name(CGS__SCENE);
    cgs__check(d, CGS__SYMBOLS, s->anchors * width, "more symbols than the file's length allows");
    cgs__check(d, CGS__FLAGS, s->total_anchors * (uint64_t)s->coupled_primitives, "more flags than the file's length allows");
    cgs__fields padding = cgs__open(d, CGS__PADDING);
    while (padding.at < padding.size) cgs__require(d, !*cgs__take(&padding, 1), "a byte is not zero");
    cgs__check_metadata(d);
    cgs__read_viewpoints(d);
    cgs__make_gaussians(d);
    cgs__make_tables(d);
    cgs__read_tables(d);
    cgs__read_networks(d, s->anchors);
    cgs__read_heads(d, s->coupled);
    cgs__read_positions(d);
    cgs__read_masks(d);
    cgs__read_latents(d, ranges, count);
    s->mask = d->mask;
}

cgs_error cgs_decode(const uint8_t *data, size_t size, int prefix, cgs_scene *scene) {
    static const uint8_t nothing[1] = {0};
    void (*const volatile decode_all)(cgs__decoder *) = cgs__decode_all; /* not inlined into what calls setjmp */
    cgs__decoder *d = (cgs__decoder *)calloc(1, sizeof *d);
    memset(scene, 0, sizeof *scene);
    strcpy(scene->message, "out of memory");
    if (!d) return CGS_OUT_OF_MEMORY;
    d->scene = scene, d->data = size ? data : nothing, d->size = size, d->prefix = prefix;
    if (!setjmp(d->jump)) {
        decode_all(d);
        scene->message[0] = 0;
        scene->memory = d->blocks;
    } else {
        char message[sizeof scene->message];
        memcpy(message, scene->message, sizeof message);
        cgs__release(d->blocks, NULL);
        memset(scene, 0, sizeof *scene);
        memcpy(scene->message, message, sizeof message);
    }
    const cgs_error error = d->error;
    free(d);
    return error;
}

void cgs_free(cgs_scene *scene) {
    cgs__release((cgs__block *)scene->memory, NULL);
    memset(scene, 0, sizeof *scene);
}

const char *cgs_error_name(cgs_error error) {
    static const char *const names[] = {"ok", "NotACompGSFile", "UnsupportedVersion", "TruncatedSection",
                                        "CorruptSection", "MissingDependency", "OutOfMemory"};
    return names[error];
}

/* ---- prediction (docs/bitstream_prediction.md) */

/* y += x W, columns side by side; x: one row. */
static void cgs__multiply(const cgs_tensor *w, const double *x, double *y) {
    const int32_t *values = w->values;
    for (uint32_t i = 0; i < w->rows; i++)
        for (uint32_t o = 0; o < w->columns; o++) y[o] += x[i] * ldexp(1, -w->exponent) * *values++;
}

static void cgs__leaky(double *y, int count) {
    while (count--) y[count] = y[count] >= 0 ? y[count] : y[count] / 64;
}

/* A residual MLP; `t` are its tensors. Returns those of the next. room: [3, width]. */
static const cgs_tensor *cgs__run_head(const cgs_tensor *t, int blocks, const double *x, double *out, double *room) {
    const double one = 1; /* what a bias is multiplied by */
    const int width = (int)t[0].columns;
    double *h = room, *u = room + width, *sum = room + 2 * (size_t)width;
    const cgs_tensor *block = t + 5;
    memset(room, 0, 3 * (size_t)width * sizeof *room);
    memset(out, 0, t[2].columns * sizeof *out);
    cgs__multiply(t, x, h), cgs__multiply(t + 1, &one, h), cgs__leaky(h, width);
    for (; blocks--; block += 4) {
        memset(u, 0, 2 * (size_t)width * sizeof *u);
        cgs__multiply(block, h, u), cgs__multiply(block + 1, &one, u), cgs__leaky(u, width);
        cgs__multiply(block + 2, u, sum), cgs__multiply(block + 3, &one, sum);
        for (int i = 0; i < width; i++) h[i] += sum[i];
    }
    cgs__multiply(t + 2, h, out), cgs__multiply(t + 3, &one, out), cgs__multiply(t + 4, x, out);
    return block;
}

/* The values of all groups of a role, side by side. */
static void cgs__dequantize(const cgs_scene *s, int role, uint32_t row, double *out) {
    for (const cgs_group *g = s->group; g < s->group + s->groups; g++)
        for (int c = 0; c < g->channels && g->role == role; c++)
            *out++ = g->latents[row * (size_t)g->channels + c] / 4096.0 * g->step[g->steps > 1 ? c : 0];
}

static double cgs__sigmoid(double x) { return 1 / (1 + exp(-x)); }

static int cgs__is_drawn(const double *gaussian) {
    const double *q = gaussian + 6;
    for (int i = 0; i < CGS_GAUSSIAN; i++)
        if (!(fabs(gaussian[i]) < ldexp(1, 127))) return 0;
    return gaussian[10] > 1 / 255.0 && sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) >= ldexp(1, -60);
}

long cgs_predict(const cgs_scene *s, const double center[3], float *out) {
    const cgs__head *head = CGS__LAYOUTS[s->heads];
    const int heads = CGS__HEADS_OF[s->heads], f = s->reference_dim, e = s->residual_dim;
    const cgs_tensor *shared = cgs__has_residuals(s) ? NULL : s->tensor + s->tensors - 1;
    double *plain = (double *)calloc(2 * (size_t)(f + 4 + e) + 3 * (size_t)s->width, sizeof *plain);
    double *viewed = plain + f + e, *room = viewed + f + 4 + e, scales[6], position[3], offset[3];
    const uint8_t *mask = s->mask;
    uint32_t primitive = 0;
    const float *start = out;
    if (!plain) return -1;
    for (uint32_t anchor = 0; anchor < s->anchors; anchor++) {
        double distance = 0;
        cgs__dequantize(s, CGS_REFERENCE, anchor, plain);
        memcpy(viewed, plain, (size_t)f * sizeof *plain);
        cgs__dequantize(s, CGS_LOG_SCALES, anchor, scales);
        for (int i = 0; i < 6; i++) scales[i] = exp(scales[i]) * s->voxel_size; /* reach, then size */
        for (int i = 0; i < 3; i++) {
            position[i] = s->coordinates[3 * (size_t)anchor + i] * s->voxel_size;
            offset[i] = position[i] - center[i];
            distance += offset[i] * offset[i];
        }
        distance = sqrt(distance);
        for (int i = 0; i < 3; i++) viewed[f + i] = offset[i] / (distance > 1e-12 ? distance : 1e-12);
        viewed[f + 3] = distance / s->view_distance_scale;
        for (int slot = 0; slot < s->coupled_primitives; slot++) {
            const cgs_tensor *t = s->tensor;
            double raw[14], g[CGS_GAUSSIAN], *r = raw;
            if (!*mask++) continue;
            for (int i = 0; shared && i < e; i++) plain[f + i] = ldexp(shared->values[slot * e + i], -shared->exponent);
            if (!shared) cgs__dequantize(s, CGS_RESIDUAL, primitive++, plain + f);
            memcpy(viewed + f + 4, plain + f, (size_t)e * sizeof *plain);
            for (int i = 0; i < heads; r += head[i++].outputs)
                t = cgs__run_head(t, head[i].blocks, head[i].sees_view ? viewed : plain, r, room);
            for (int i = 0; i < 3; i++) {
                g[i] = position[i] + raw[i] * scales[i];
                g[3 + i] = cgs__sigmoid(raw[3 + i]) * scales[3 + i];
                g[11 + i] = cgs__sigmoid(raw[11 + i]);
            }
            for (int i = 0; i < 4; i++) g[6 + i] = raw[6 + i] + (i == 0);
            g[10] = tanh(raw[10]);
            for (int i = 0; i < CGS_GAUSSIAN; i++) out[i] = (float)g[i];
            if (cgs__is_drawn(g)) out += CGS_GAUSSIAN;
        }
    }
    free(plain);
    return (long)((out - start) / CGS_GAUSSIAN);
}

#endif /* COMPGS_IMPLEMENTATION */
