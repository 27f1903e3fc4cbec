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
 * C99 or C++; needs the standard library and -lm. It reads versions 2 to 5, whole files and their beginnings, and refuses
 * what the document refuses; positions by G-PCC it does not read. Nothing is kept: several threads may decode at once.
 * Allocations are bounded by the limits of the document. License: Apache-2.0, as the rest of CompGS.
 *
 * Its 1 911 lines of code are half of those of the decoder for the web: container and limits 500, tables, streams and
 * arrays 250, networks and heads 250, the arithmetic code and the octree 540, latents and masks 280, optional sections
 * 100, Gaussians 120. Leaving out versions 2 to 4, or beginnings of files, would save less than 100 of them each.
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
    int coupled_primitives, residual_dim, reference_dim, separate_heads, width, depth;
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
    CGS__GAUSSIAN_COUNT = 128, CGS__MAX_HYPER_SYMBOLS = 1024, CGS__CHUNK_SYMBOLS = 1 << 20,
    CGS__SINGLE_STATE_SYMBOLS = 1 << 18, CGS__MAX_ESCAPE_BYTES = 5, CGS__ACTIVATION_LIMIT = 1 << 23,
    CGS__MAX_SHIFT = 30, CGS__MAX_LAYERS = 8, CGS__MAX_LAYER_WIDTH = 1 << 16, CGS__MAX_NAME_BYTES = 64,
    CGS__MAX_RANK = 4, CGS__MAX_EXPONENT = 62, CGS__MAX_WEIGHTS = 1 << 22, CGS__MAX_LOW_BITS = 26,
    CGS__FOLLOW_LIMIT = 1 << 28, CGS__CHAIN_LIMIT = 1 << 12, CGS__MAX_INERTIA = 63, CGS__SIZE_OFFSET = 1229,
    CGS__SIZE_CAP = 4, CGS__LARGEST_TABLE_SHIFT = 36, CGS__MAX_DEPTH = 21, CGS__ONE = 4096
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

/* M(d) of "Rows": floor(2^(15 + (2 d - 1) / 24)), d = -36 ... 36. */
static const int32_t CGS__RATIOS[73] = {
    3979, 4216, 4466, 4732, 5013, 5311, 5627, 5962, 6316, 6692, 7090, 7512,
    7958, 8432, 8933, 9464, 10027, 10623, 11255, 11924, 12633, 13385, 14180, 15024,
    15917, 16864, 17866, 18929, 20054, 21247, 22510, 23849, 25267, 26770, 28361, 30048,
    31835, 33728, 35733, 37858, 40109, 42494, 45021, 47698, 50535, 53540, 56723, 60096,
    63670, 67456, 71467, 75717, 80219, 84989, 90043, 95397, 101070, 107080, 113447, 120193,
    127340, 134912, 142935, 151434, 160439, 169979, 180086, 190795, 202140, 214160, 226895, 240387,
    254681
};

/*
 * The Gaussian tables of the document in base 64. Of each, as varints: r, f(escape), f(r), and by how much each of
 * f(r - 1), ..., f(1) is larger than the one before it in this list. Their checksum is looked at when they are read.
 */
static const char *const CGS__GAUSSIANS[] = {
    "AgEBAAIBAQACAQEAAgEBAAIBAQACAQEAAgEBAAIBAQACAQEAAgEBAAIBAQACAQEAAgEBAAIBAQACAQEAAgEBAAIBAQACAQEAAgEBAAIBAQACAQEA",
    "AgEBAAIBAQACAQEAAgEBAQIBAQQCAQELAgEBGAIBATACAQFYAgEBmAECAQH4AQIBAYADAwEBALkEAwEBAKsGAwEBANwIAwEBANILAwEBAI4PAwEB",
    "AJETAwEBANoXAwEBAOMcAwEBAKciAwEBAKEoAwEBAcUuAwEBBIw1BAEBAAvoOwQBAQAYzEIEAQEAMKlJBAEBAFftTwQBAQCXAYFWBAEBAPUB0VsE",
    "AQEA/ALGYAUBAQABsQTLZAUBAQAFmwbOZwUBAQAMvAjBaQUBAQAbkwuaagUBAQA0mw7XaQYBAQAAX8cR/WcGAQEAAp4BiRWVZQYBAQAG+wHMGK9h",
    "BgEBAA75Avsb31wHAQEAAB6ZBIQfuVcHAQEAATjcBdIh1lEHAQEABGC9B9cjzUsIAQEAAAqdAbAJiyWxRQgBAQAAFu8BrQvoJZc/CQEBAAACKtgC",
    "pQ3wJY45CQEBAAAGSdcDig+rJaMzCQEBAAAPdekE0BCfJN8tCgEBAAACHbEBhQbuEdoiyigKAQEAAAcy/gGjB94S6CDmIwsBAQAAAQ9R2gK7CJwT",
    "1R64HwsBAQAABBt9wQPCCasTrRy/GwwBAQAAAQkvtQGsBLMKjRP8GfgXDQEBAAAAAxJL9wGXBYkLxxLLF+MUDQEBAAABByBwwQL7Bb8L4xGfFfwR",
    "DgEBAAAAAw80ngGPA9EG1wvmEIATvw8PAQEAAAABBxpQ0wHcA5YH0wvVD/IQqg0QAQEAAAAABA4qc4wCpATHB7MLvA72DrgLEAEBAAAAAggYQZoB",
    "yALiBOMH/gqdDY8N5QkRAQEAAAABBQ4nXMgBgAOTBeoHuAr+C70LsAgSAQEAAAAABAkYOn71AbMDtgXeB+QJ5AqACpIHEwEBAAAAAAIHECZSogGi",
    "At4DyQXBB4kJ0AnXCIoGFAEBAAAAAAIEDBs4bccBywL9A84FmAeoCMUIwQeWBRUBAQAAAAABBAkTKE6LAesB7QKSBMQF5AbHB8QHvQazBBcBAQAA",
    "AAAAAQMHDx45ZaoBiwKJA5oErwWpBugGzQbJBd4DGAEBAAAAAAABAwUMGCtNf8YBpwKaA5gEkAXqBYwG4wXjBJUDGQEBAAAAAAABAgULEyI8YZgB",
    "4QG7AqMDjATqBKkFtQWDBYwE1wIbAQEAAAAAAAABAgUJEB0wTXevAfYByQKiA/kDwATnBOUErQS/A6MCHAEBAAAAAAAAAQIFCA4ZKD9giwHDAYYC",
    "zwKbA98DkQSpBJoE4QP+AvYBHgEBAAAAAAAAAAEDBAgNFSI1UHGeAdMBjwLPAowDwQPjA+wD1wOfA8UCzwEfAQEAAAAAAAAAAgIFBwwTHy1DX4MB",
    "rQHeAZMCyAL4Ap8DtQO0A5oD5AKVAq8BIQEBAAAAAAAAAAEBAwQICxIcKDpRbpABuAHkAZECvQLhAvwCiAOAA+MCsgLrAZQBIwEBAAAAAAAAAAAB",
    "AgMECAsRGSUzR156mwG/AeUBiwKsAsgC2QLdAtACtAKFAscBfSUBAQAAAAAAAAAAAQECAwUHDBAYIi4+UmqEAaIBwgHiAYACmgKsArcCtAKmAokC",
    "3wGpAWonAQEAAAAAAAAAAAABAgIDBgcMEBcfKzhIXXKMAaYBwQHaAfIBhQKSApUCjwKAAuQBvgGPAVkpAQEAAAAAAAAAAAABAQICBAYICxEWHicz",
    "QlJkeZABpgG8AdEB4gHvAfYB9gHuAd0BxAGiAXlLLAEBAAAAAAAAAAAAAAEAAgIDBAYJDBAWHSUvPElZa32QAaMBtQHEAdEB2gHcAdkBzwG/AacB",
    "igFmQC4BAQAAAAAAAAAAAAAAAQECAwMFBwkMERUcIyw3Q1Bfbn6OAZ4BqwG2Ab8BxAHEAb4BtAGlAY4BdVc1MQEBAAAAAAAAAAAAAAAAAQECAgME",
    "BQcKDREVGyIqMz1JVGJwfIoBlgGgAagBrQGvAawBpwGcAY0BemNJLTQBAQAAAAAAAAAAAAAAAAABAQECAwMFBggKDhEVGyEnMDhDTFhjbnqDAYwB",
    "lAGZAZwBmwGYAZEBhgF5aFQ9JjcBAQAAAAAAAAAAAAAAAAABAAEBAgIDBAYHCAsOEhUbHyYtNTxGT1lia3R8ggGHAYoBiwGJAYUBfnNoWEc0IDoB",
    "AQAAAAAAAAAAAAAAAAAAAQABAQICAwQEBggJDA8SFRofJCsxOEBIT1hgZm5zd3t7fHhzbWNYSzwsGz0BAQAAAAAAAAAAAAAAAAAAAAEBAQEBAgMD",
    "BQUHCAoNDxIWGh4jKC40O0FIT1ZbYWZqbG5vbGlkXlVLQDIlF0EBAQAAAAAAAAAAAAAAAAAAAAABAAEBAQICAgMEBQcHCQsNEBMWGR0iJiwwNztC",
    "R0xSV1peYGJiYl9bV1BJQDYrHxNFAQEAAAAAAAAAAAAAAAAAAAAAAAABAQABAgECAwMEBAYHCAoMDhATFhkdICUpLTI3PEBFSU1RU1ZXV1dWU09L",
    "RT42LiQaEEkBAQAAAAAAAAAAAAAAAAAAAAAAAAABAAEBAQECAgMDAwUFBwgJCg0OERMWGBwgIyYrLjM2Oz5CRUdLTE1OTk1LSEVAOzQuJx8WDU0B",
    "AQAAAAAAAAAAAAAAAAAAAAAAAAAAAQABAQEBAQICAwMDBQUGBwkKCw0PERMWGRseISUnKy8yNTg7PkFCREVFRkRDQj47NzMtJyAaEwtRAQEAAAAA",
    "AAAAAAAAAAAAAAAAAAAAAAABAAEBAAIBAQICAwMEBAUGBwgJCwwNEBETFhgaHSAiJigqLjEzNTg5Oz09Pj49PTo5NjMvKyYhHBUQClYBAQAAAAAA",
    "AAAAAAAAAAAAAAAAAAAAAAABAAABAQABAgECAgIDAwQEBQYHBwkKCwwOEBITFRcaHB4gIyUoKiwuMDI0NTY3Nzc3NjQzMS8rKSQhHBcSDQhbAQEA",
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAABAAEAAQEAAgEBAgIDAwMEBAUGBggICQsMDQ4QERMVFxkaHR4hIiUmKSorLS8vMDExMTEwLy4sKyglIh8c",
    "FxQPDAZhAQEAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAEAAAEAAQEBAQECAQICAwMEAwUFBgYHCAkKCwwNDxARExUWFxkbHR4hISMlJigoKior",
    "LCwrLCsqKSgmJSIgHRoXFBENCQZmAQEAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAABAAABAAEAAQEBAQIBAgIDAwMDBAUFBgYHCAgKCgsNDQ8Q",
    "ERMUFRYYGhscHh8gISMkJCUmJycnJycmJSUkIiEfHhsZFhQRDgsHBWwBAQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAQAAAQABAAEBAQEB",
    "AQICAgIDAwMEBAQFBgYHCAgJCgsLDQ4OEBESExQWFxgZGhsdHR8fISEhIiMiIyMiIiIhIB4eHBsZFxUTEQ4MCQcEcwEBAAAAAAAAAAAAAAAAAAAA",
    "AAAAAAAAAAAAAAAAAAAAAAABAAABAAEAAQEAAQECAQIBAgMCAwMEAwUEBQYGBwcICQoKCwwMDg4QEBISFBQWFhcZGRobHBwdHh4fHh8fHx8eHh0d",
    "GxsaGBcVFBEQDg0JCAYDeQEBAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAQAAAAEAAQABAAEBAQECAQIBAgMCAwMDBAMFBQUFBwYH",
    "CAkJCgoLDA0NDg8QERISExUUFhcXGBgaGRsaGxwbHBscGxsbGhkZGBcVFRQSEA8ODAoIBwUDgAEBAQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA",
    "AAAAAAAAAAAAAAEAAAEAAAEAAQEAAQEBAQIBAgICAgIDAwMDBAQEBQYFBgcHCAgICgoKCwwNDQ4OEBAQEhITExQVFRYXFhgXGBkYGRgZGBgYGBcX",
    "FhUVExMSEBAODQsKCQcFBAOIAQEBAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAQAAAAEAAQABAAEBAAEBAQIBAgECAgID",
    "AgMDAwQEBAUEBgUGBwcHCAgJCgoKCwwMDQ0ODw8QEBESEhIUExQUFRUVFhYVFhYWFhUWFRQUFBMSEhEQDw4NDAsJCQcGBQMCkAEBAQAAAAAAAAAA",
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAQAAAAABAAEAAAEBAAEBAQEBAQECAQICAgICAwMDAwMEBAQFBQUGBgYHBwgICAkKCgoL",
    "CwwMDQ4ODg8PEBARERESEhMSExMUExQTFBMTExMTEhIREREPEA4NDQwLCgoIBwYFBAMBmQEBAQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA",
    "AAAAAAAAAAAAAAAAAAAAAAEAAAABAAABAAABAQABAQABAQEBAgECAQICAgICAwMDAwMEBAQEBQUFBgUHBgcIBwgJCQkKCgsLCwwMDQ0NDg8ODxAP",
    "EBAREBEREhEREhERERIREBEQEA8PDw4NDQwMCwoJCQgHBgUEAwMBoQEBAQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA",
    "AAAAAAAAAQAAAAABAAABAAEAAQABAQABAQEBAQECAQIBAgICAgMCAwMDAwQDBAUEBQUFBQYGBwcHBwgICAkJCgoKCgsLDAwMDQ0NDQ4ODw4PDw8P",
    "DxAPEA8PEA8PDw8PDg4ODQ0MDAwLCgoKCAgHBwYFBAQCAgKrAQEBAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA",
    "AAAAAAAAAQAAAAABAAABAAABAAEAAQEAAQEBAQEBAQIBAQICAgICAgIDAwIDBAMEAwUEBAUFBQYFBgYHBwcHCAgICQkJCQoKCgsLCwsMDAwNDA0N",
    "DQ0ODQ4ODg0ODg4NDg0ODQ0MDQwMCwsLCgoJCQgICAYGBgUEBAMCAgG1AQEBAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA",
    "AAAAAAAAAAAAAAAAAAAAAQAAAAABAAAAAQAAAQABAAEAAQEAAQEBAQEBAQIBAQICAQICAwICAwIDAwMEAwQEBAQFBAUFBgUGBgYHBwcHBwgICAkJ",
    "CQkJCgoKCwoLCwsMCwwMCwwNDAwMDA0MDAwNDAsMDAsLCwsKCwkKCQkICAgHBgcFBQUEBAMCAgIBwAEBAQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA",
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAABAAAAAAABAAAAAQAAAQABAAEAAQABAQEAAQEBAQECAQECAQICAgEDAgICAwMCAwME",
    "AwQDBAQFBAUFBQUFBgYGBgYHBwcHCAcICAkICQkJCQkKCgoKCgoLCgsLCwsKCwsLCwsLCwoLCwoKCgoKCQkJCQgJBwgHBwYGBgUFBAQDBAICAgEB",
    "ywEBAQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAQAAAAAAAQAAAAEAAAEAAAEA",
    "AQABAAEBAAEBAQEBAQEBAQECAQIBAgICAgICAgMCAwMDAwMDBAMEBAQEBQQFBQUFBQYGBgYGBgcHBwcHCAcICAgJCAkICQkJCgkJCgkKCQoKCgkK",
    "CgoJCgkKCQoJCQkICQgICAgHBwcHBgYGBgUEBQQEAwMCAgICAQDXAQEBAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA",
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAQAAAAAAAAEAAAABAAAAAQABAAABAAEAAQEAAQEBAAEBAQECAQEBAgECAQICAQICAwICAgMDAgMDAwQD",
    "AwQEBAQEBAQFBQUFBQUFBgYGBgYGBwcGBwcHCAcIBwgICAgICQgJCAkICQgJCQgJCQgJCQgJCAgICAgICAcIBwcGBwYHBQYFBgQFBAQEBAMCAwIC",
    "AQIAAeQBAQEAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAEAAAAA",
    "AAABAAAAAAEAAAEAAAEAAAEAAQABAAEBAAEBAQABAQEBAQECAQECAQIBAgIBAgICAgMCAgMCAwMDAwMDBAMEAwQEBAQEBQQFBQUFBQUGBQYGBgYG",
    "BgYHBwYHBwcHBwcIBwcICAcIBwgICAcICAgHCAgHCAcHCAcHBwcGBwcGBgYGBQYFBQUEBQQEAwQDAwIDAgIBAQEBAfEBAQEAAAAAAAAAAAAAAAAA",
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAQAAAAAAAAEAAAAAAQAAAAEAAAEA",
    "AAEAAQABAAEAAQEAAQEBAAEBAQEBAQIBAQECAQIBAgIBAgICAgIDAgIDAgMDAwIDBAMDBAMEAwQEBAQFBAQFBQQFBQUFBgUGBQYGBQYGBwYGBgcG",
    "BwYHBwYHBwcHBwYHBwcHBwcHBgcHBgcGBwYGBgYGBgYFBgUFBQUEBQQEBAQDBAMCAwMCAgIBAQEBAQAA",
};

/* ---- what a decoder knows */

typedef struct {
    int32_t lowest, entries;  /* entries: the escape, which comes last, included */
    int64_t expected;         /* E, of a Gaussian table */
    const uint32_t *cumulated; /* [entries + 1] */
} cgs__table;

typedef struct {
    int number;
    const uint8_t *data;
    size_t size;
} cgs__section;

typedef struct {
    int inputs, outputs, shift, adds, rectify;
    int32_t *weight; /* [outputs, inputs] */
    int32_t *bias;
} cgs__layer;

typedef struct {
    int layers, skip, has_chain, follow_shift, inertia;
    cgs__layer layer[CGS__MAX_LAYERS];
    int32_t *follow, *chain; /* or NULL */
} cgs__network;

typedef struct cgs__block {
    struct cgs__block *before, *next;
} cgs__block;

typedef struct {
    jmp_buf jump;
    cgs_error error;
    cgs_scene *scene;
    cgs__block *blocks;
    const char *section; /* that is read, for messages */
    const uint8_t *data;
    size_t size;
    int prefix, sections, whole; /* whole: all latents that the header names are there */
    cgs__section section_of[CGS__MAX_SECTIONS];
    cgs__table gaussian[CGS__GAUSSIAN_COUNT];
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

/* Zeros, which belong to the decoder until the end. */
static void *cgs__alloc(cgs__decoder *d, uint64_t count, size_t size) {
    cgs__block *block = NULL;
    const size_t head = 2 * sizeof(uint64_t) > sizeof *block ? 2 * sizeof(uint64_t) : sizeof *block;
    if (count < (SIZE_MAX - head) / size) block = (cgs__block *)calloc(1, head + (size_t)count * size);
    if (!block) cgs__fail(d, CGS_OUT_OF_MEMORY, "out of memory");
    block->next = d->blocks;
    if (d->blocks) d->blocks->before = block;
    d->blocks = block;
    return (char *)block + head;
}

static void cgs__release(cgs__decoder *d, void *memory) {
    const size_t head = 2 * sizeof(uint64_t) > sizeof(cgs__block) ? 2 * sizeof(uint64_t) : sizeof(cgs__block);
    cgs__block *block = (cgs__block *)((char *)memory - head);
    if (block->before) block->before->next = block->next;
    else d->blocks = block->next;
    if (block->next) block->next->before = block->before;
    free(block);
}

static void cgs__free_all(cgs__block *block) {
    while (block) {
        cgs__block *next = block->next;
        free(block);
        block = next;
    }
}

/* Arithmetic shift, also where that of the machine is another. */
static int64_t cgs__right(int64_t v, int bits) { return v >= 0 ? v >> bits : ~(~v >> bits); }

static int64_t cgs__clamp(int64_t v, int64_t lowest, int64_t highest) {
    return v < lowest ? lowest : v > highest ? highest : v;
}

static int32_t cgs__activation(int64_t v) {
    return (int32_t)cgs__clamp(v, -CGS__ACTIVATION_LIMIT, CGS__ACTIVATION_LIMIT - 1);
}

static int64_t cgs__floor_div(int64_t a, int64_t b) { /* b > 0 */
    return a >= 0 ? a / b : -((-a + b - 1) / b);
}

static int cgs__ones(uint64_t v) {
    int count = 0;
    for (; v; v &= v - 1) count++;
    return count;
}

static uint32_t cgs__crc32(const uint8_t *data, size_t size) {
    uint32_t table[256], crc = 0xffffffffu, i;
    size_t at;
    int bit;
    for (i = 0; i < 256; i++) {
        table[i] = i;
        for (bit = 0; bit < 8; bit++) table[i] = table[i] & 1 ? 0xedb88320u ^ (table[i] >> 1) : table[i] >> 1;
    }
    for (at = 0; at < size; at++) crc = table[(crc ^ data[at]) & 255] ^ (crc >> 8);
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

typedef struct {
    cgs__decoder *d;
    const uint8_t *data;
    size_t size, at;
} cgs__fields;

static cgs__fields cgs__fields_of(cgs__decoder *d, const uint8_t *data, size_t size) {
    cgs__fields f;
    f.d = d, f.data = data, f.size = size, f.at = 0;
    return f;
}

static const uint8_t *cgs__take(cgs__fields *f, uint64_t bytes) {
    cgs__require(f->d, bytes <= f->size - f->at, "the section ends within a field");
    f->at += (size_t)bytes;
    return f->data + f->at - bytes;
}

static uint64_t cgs__unsigned(cgs__fields *f, int bytes) { return cgs__little(cgs__take(f, (uint64_t)bytes), bytes); }

static uint64_t cgs__between(cgs__decoder *d, uint64_t value, uint64_t lowest, uint64_t highest, const char *what) {
    cgs__require(d, value >= lowest && value <= highest, what);
    return value;
}

static uint64_t cgs__raw_varint(cgs__fields *f, int most_bytes) {
    uint64_t value = 0;
    int i;
    for (i = 0; i < most_bytes; i++) {
        const uint8_t byte = *cgs__take(f, 1);
        value |= (uint64_t)(byte & 127) << (7 * i);
        if (byte < 128) {
            cgs__require(f->d, byte || !i, "a number is spelled with a needless byte");
            return value;
        }
    }
    cgs__fail(f->d, CGS_CORRUPT_SECTION, "a number has too many bytes");
    return 0;
}

static uint64_t cgs__varint(cgs__fields *f, uint64_t lowest, uint64_t highest, const char *what) {
    return cgs__between(f->d, cgs__raw_varint(f, 9), lowest, highest, what);
}

static int64_t cgs__signed(cgs__fields *f, int most_bytes, int64_t limit, const char *what) {
    const uint64_t raw = cgs__raw_varint(f, most_bytes);
    const int64_t value = raw & 1 ? -(int64_t)(raw >> 1) - 1 : (int64_t)(raw >> 1);
    cgs__require(f->d, value >= -limit && value <= limit, what);
    return value;
}

static double cgs__f64(cgs__fields *f) {
    const uint64_t bits = cgs__unsigned(f, 8);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static float cgs__f32(cgs__fields *f) {
    const uint32_t bits = (uint32_t)cgs__unsigned(f, 4);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void cgs__end(cgs__fields *f) { cgs__require(f->d, f->at == f->size, "bytes are left over after the last field"); }

static int cgs__is_text(const uint8_t *text, size_t size) { /* well-formed UTF-8 */
    size_t at = 0;
    while (at < size) {
        const uint8_t lead = text[at++];
        const int more = lead < 0x80 ? 0 : lead < 0xc2 ? -1 : lead < 0xe0 ? 1 : lead < 0xf0 ? 2 : lead < 0xf5 ? 3 : -1;
        int i;
        if (more < 0 || (size_t)more > size - at) return 0;
        for (i = 0; i < more; i++) {
            uint8_t low = 0x80, high = 0xbf;
            if (i == 0 && lead == 0xe0) low = 0xa0;
            if (i == 0 && lead == 0xed) high = 0x9f;
            if (i == 0 && lead == 0xf0) low = 0x90;
            if (i == 0 && lead == 0xf4) high = 0x8f;
            if (text[at] < low || text[at] > high) return 0;
            at++;
        }
    }
    return 1;
}

/* ---- file */

static const char *cgs__name(int number) {
    static const char *const names[] = {"",      "scene",  "positions",        "positions (G-PCC)",
                                        "masks", "tables", "entropy networks", "prediction heads",
                                        "latents"};
    if (number <= CGS__LATENTS) return names[number];
    return number == CGS__METADATA ? "metadata" : number == CGS__PADDING ? "padding"
         : number == CGS__VIEWPOINTS ? "viewpoints" : "optional section";
}

static const cgs__section *cgs__find(cgs__decoder *d, int number) {
    int i;
    for (i = 0; i < d->sections; i++)
        if (d->section_of[i].number == number) return d->section_of + i;
    return NULL;
}

static cgs__fields cgs__open(cgs__decoder *d, int number) {
    const cgs__section *section = cgs__find(d, number);
    d->section = cgs__name(number);
    return cgs__fields_of(d, section->data, section->size);
}

static void cgs__check_numbers(cgs__decoder *d, const uint8_t *table, int count) {
    int seen[256] = {0}, before = 0, i;
    for (i = 0; i < count; i++) {
        const int number = table[9 * i];
        if (number < CGS__OPTIONAL && (number < CGS__SCENE || number > CGS__LATENTS))
            cgs__fail(d, CGS_UNSUPPORTED_VERSION, "a section is unknown and must not be skipped");
    }
    for (i = 0; i < count; i++) {
        const int number = table[9 * i];
        cgs__require(d, !seen[number] || number == CGS__LATENTS, "a section is there twice");
        seen[number]++;
        if (number >= CGS__OPTIONAL) continue;
        cgs__require(d, number >= before, "the sections are not in order");
        before = number;
    }
    for (i = CGS__SCENE; i <= CGS__LATENTS; i++)
        cgs__require(d, seen[i] || i == CGS__POSITIONS || i == CGS__GPCC, "a section is missing");
    cgs__require(d, seen[CGS__POSITIONS] + seen[CGS__GPCC] == 1, "expected one section of positions");
    cgs__require(d, seen[CGS__LATENTS] <= CGS__MAX_RANGES, "there are too many sections of latents");
}

static void cgs__unpack(cgs__decoder *d) {
    static const uint8_t magic[4] = {0x93, 'C', 'G', 'S'};
    const uint8_t *data = d->data;
    int count, i, has_latents = 0;
    size_t at;
    d->section = "header";
    if (memcmp(data, magic, d->size < 4 ? d->size : 4)) cgs__fail(d, CGS_NOT_A_COMPGS_FILE, "not a .cgs file");
    if (d->size < 7) cgs__fail(d, CGS_TRUNCATED_SECTION, "the file ends within it");
    if (data[4] < CGS__OLDEST_VERSION || data[4] > CGS__VERSION)
        cgs__fail(d, CGS_UNSUPPORTED_VERSION, "a version that this decoder does not read");
    d->scene->version = data[4];
    count = data[6];
    at = 11 + 9 * (size_t)count;
    if (d->size < at) cgs__fail(d, CGS_TRUNCATED_SECTION, "the file ends within it");
    cgs__require(d, cgs__crc32(data, at - 4) == cgs__little(data + at - 4, 4), "its checksum does not match");
    cgs__require(d, !data[5], "reserved flags are set");
    cgs__require(d, count <= CGS__MAX_SECTIONS, "too many sections");
    cgs__check_numbers(d, data + 7, count);
    d->whole = 1;
    for (i = 0; i < count; i++) {
        cgs__section *section = d->section_of + d->sections;
        const uint8_t *entry = data + 7 + 9 * i;
        section->number = entry[0];
        section->size = (size_t)cgs__little(entry + 1, 4);
        section->data = data + at;
        d->section = cgs__name(entry[0]);
        if (section->size > d->size - at) {
            if (!d->prefix || !has_latents) cgs__fail(d, CGS_TRUNCATED_SECTION, "the file ends within it");
            for (; i < count; i++) d->whole &= data[7 + 9 * i] != CGS__LATENTS;
            return;
        }
        cgs__require(d, cgs__crc32(section->data, section->size) == cgs__little(entry + 5, 4),
                     "its checksum does not match");
        has_latents |= entry[0] == CGS__LATENTS;
        at += section->size;
        d->sections++;
    }
    d->section = "file";
    cgs__require(d, at == d->size, "bytes are left over after the last section");
}

/* ---- scene */

static int cgs__sees(const cgs_scene *s, int i, int group) { return s->group[i].context >> (group + 1) & 1; }

static int cgs__slots(const cgs_scene *s, int i) { return s->group[i].role == CGS_RESIDUAL ? s->coupled_primitives : 1; }

static int cgs__width(const cgs_scene *s, int i) { return cgs__slots(s, i) * s->group[i].channels; }

static int cgs__inputs(const cgs_scene *s, int i) {
    int inputs = 3 * (int)(s->group[i].context & 1) + 2 * cgs__sees(s, i, i), j;
    for (j = 0; j < i; j++) inputs += cgs__sees(s, i, j) ? s->group[j].channels : 0;
    return inputs;
}

static int cgs__is_within(double value, double lowest, double highest) { return value >= lowest && value <= highest; }

static void cgs__read_group(cgs__fields *f, cgs_scene *s, int i) {
    static const int most[] = {64, 256, 6, 64};
    cgs_group *g = s->group + i;
    int j;
    g->role = (int)cgs__varint(f, 0, 3, "role of a group");
    g->channels = (int)cgs__varint(f, 1, (uint64_t)most[g->role], "channels of a group");
    g->context = (uint32_t)cgs__varint(f, 0, ((uint64_t)1 << (i + 1 + (s->version >= CGS__FIRST_WITH_NEIGHBOURS))) - 1,
                                       "context of a group");
    g->steps = (int)cgs__varint(f, 0, (uint64_t)g->channels, "steps of a group");
    cgs__require(f->d, g->role == CGS_SIDE ? !g->steps : g->steps == 1 || g->steps == g->channels, "steps of a group");
    for (j = 0; j < g->steps; j++) {
        g->step[j] = cgs__f32(f);
        cgs__require(f->d, cgs__is_within(g->step[j], ldexp(1, -64), ldexp(1, 64)), "a step");
    }
    for (j = 0; j < i; j++)
        cgs__require(f->d, !cgs__sees(s, i, j) || s->group[j].role != CGS_RESIDUAL, "a group takes residuals");
    cgs__require(f->d, !(g->role == CGS_RESIDUAL && cgs__sees(s, i, i)), "residuals take what neighbours have");
    cgs__require(f->d, g->context || cgs__width(s, i) <= CGS__MAX_TABLES, "a group has too many tables");
}

static void cgs__read_scene(cgs__decoder *d) {
    const double smallest = ldexp(1, -64), largest = ldexp(1, 64);
    cgs__fields f = cgs__open(d, CGS__SCENE);
    cgs_scene *s = d->scene;
    int channels[4] = {0}, i;
    s->total_anchors = (uint32_t)cgs__between(d, cgs__unsigned(&f, 4), 1, CGS__MAX_ANCHORS, "number of anchors");
    d->promised_coupled = (uint32_t)cgs__unsigned(&f, 4);
    s->coupled_primitives = (int)cgs__between(d, cgs__unsigned(&f, 1), 1, 64, "coupled_primitives");
    cgs__require(d, d->promised_coupled <= (uint64_t)s->total_anchors * (unsigned)s->coupled_primitives,
                 "more coupled primitives than slots");
    s->residual_dim = (int)cgs__between(d, cgs__unsigned(&f, 1), 1, 64, "residual_dim");
    s->separate_heads = !cgs__between(d, cgs__unsigned(&f, 1), 0, 1, "heads");
    s->width = (int)cgs__between(d, cgs__unsigned(&f, 2), 1, 1024, "width");
    s->voxel_size = cgs__f64(&f);
    cgs__require(d, cgs__is_within(s->voxel_size, smallest, largest), "voxel_size");
    for (i = 0; i < 3; i++) {
        s->world_offset[i] = cgs__f64(&f);
        cgs__require(d, cgs__is_within(s->world_offset[i], -largest, largest), "world_offset");
    }
    s->view_distance_scale = cgs__f64(&f);
    cgs__require(d, cgs__is_within(s->view_distance_scale, smallest, largest), "view_distance_scale");
    for (i = 0; i < 3; i++) {
        s->background[i] = cgs__f32(&f);
        cgs__require(d, cgs__is_within(s->background[i], -largest, largest), "background");
    }
    if (s->version >= CGS__FIRST_WITH_DILATION) {
        s->angular_dilation = cgs__f32(&f);
        cgs__require(d, cgs__is_within(s->angular_dilation, ldexp(1, -40), 1), "angular_dilation");
    }
    s->groups = (int)cgs__between(d, cgs__unsigned(&f, 1), 1, CGS_MAX_GROUPS, "number of groups");
    for (i = 0; i < s->groups; i++) {
        cgs__read_group(&f, s, i);
        channels[s->group[i].role] += s->group[i].channels;
    }
    cgs__end(&f);
    s->reference_dim = (int)cgs__between(d, (uint64_t)channels[CGS_REFERENCE], 1, 256, "channels of references");
    cgs__require(d, channels[CGS_LOG_SCALES] == 6, "channels of log scales");
    cgs__require(d, !channels[CGS_RESIDUAL] || channels[CGS_RESIDUAL] == s->residual_dim, "channels of residuals");
}

/* ---- tables */

static uint8_t *cgs__from_base64(cgs__decoder *d, size_t *size) {
    static const char letters[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    const size_t lines = sizeof CGS__GAUSSIANS / sizeof *CGS__GAUSSIANS;
    uint8_t *bytes = (uint8_t *)cgs__alloc(d, 112 * lines, 1);
    uint32_t bits = 1; /* a 1 in front of what is not written yet */
    size_t line;
    for (line = 0, *size = 0; line < lines; line++) {
        const char *text = CGS__GAUSSIANS[line];
        for (; *text; text++) {
            bits = bits << 6 | (uint32_t)(strchr(letters, *text) - letters);
            if (!(bits >> 24)) continue;
            bytes[(*size)++] = (uint8_t)(bits >> 16), bytes[(*size)++] = (uint8_t)(bits >> 8);
            bytes[(*size)++] = (uint8_t)bits;
            bits = 1;
        }
    }
    return bytes;
}

static void cgs__read_gaussians(cgs__decoder *d) {
    uint32_t *cumulated = (uint32_t *)cgs__alloc(d, 2 * 9678, sizeof *cumulated);
    uint8_t *document = (uint8_t *)cgs__alloc(d, 9678, 1), *at = document; /* in its layout, for the checksum */
    size_t size;
    uint8_t *bytes = cgs__from_base64(d, &size);
    cgs__fields f = cgs__fields_of(d, bytes, size);
    int i, q;
    for (i = 0; i < CGS__GAUSSIAN_COUNT; i++, cumulated += 2) {
        cgs__table *table = d->gaussian + i;
        uint32_t frequency[1003] = {0}, *of = frequency + 1; /* r, f(0), ..., f(r), f(escape) */
        const int r = (int)cgs__varint(&f, 1, 1000, "r");
        const uint32_t escape = (uint32_t)cgs__varint(&f, 1, 65535, "f(escape)");
        frequency[0] = (uint32_t)r, of[0] = 65536 - escape;
        for (q = r; q > 0; q--) {
            of[q] = (q < r ? of[q + 1] : 0) + (uint32_t)cgs__varint(&f, 0, 65535, "f");
            of[0] -= 2 * of[q];
            table->expected += (int64_t)q * of[q];
        }
        of[r + 1] = escape;
        for (q = -1; q <= r + 1; q++) *at++ = (uint8_t)of[q], *at++ = (uint8_t)(of[q] >> 8);
        table->lowest = -r, table->entries = 2 * r + 2, table->expected /= 8;
        table->cumulated = cumulated;
        for (q = -r; q <= r; q++, cumulated++) cumulated[1] = cumulated[0] + of[q < 0 ? -q : q];
        cumulated[1] = cumulated[0] + escape;
    }
    cgs__require(d, cgs__crc32(document, 9678) == 0xad3b4090u, "the Gaussian tables of this decoder are damaged");
    cgs__release(d, document);
    cgs__release(d, bytes);
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

static int cgs__table_shift(int64_t seen, int64_t expected) {
    int low = 0, high = 2 * CGS__LARGEST_TABLE_SHIFT + 1;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (32768 * seen >= expected * CGS__RATIOS[middle]) low = middle;
        else high = middle;
    }
    return low - CGS__LARGEST_TABLE_SHIFT;
}

/* Symbols [first, end) of a stream, INT32_MIN for escapes; `index` becomes that of the tables that were used. */
static void cgs__read_chunk(cgs__fields *words, const cgs__table *tables, cgs__rows rows, uint8_t *index,
                            int32_t *symbols, uint64_t first, uint64_t end) {
    cgs__decoder *d = words->d;
    const int states = end - first < CGS__SINGLE_STATE_SYMBOLS ? 1 : 2;
    uint64_t state[2], i;
    int64_t seen = 0, expected = 0;
    int shift = 0, k;
    for (k = 0; k < states; k++) {
        state[k] = cgs__unsigned(words, 8);
        cgs__require(d, state[k] >> 31 && !(state[k] >> 63), "a state begins out of range");
    }
    for (i = first; i < end; i++) {
        const cgs__table *table, *given = tables + index[i];
        uint64_t *x = state + ((i - first) & (uint64_t)(states - 1));
        const uint32_t slot = (uint32_t)(*x & 65535);
        int j;
        if (rows.inertia) {
            if (i == first || i % (unsigned)rows.channels == 0) {
                seen = expected = (int64_t)CGS__ONE * rows.inertia;
                shift = 0;
            }
            index[i] = (uint8_t)cgs__clamp(index[i] + shift, 0, CGS__GAUSSIAN_COUNT - 1);
        }
        table = tables + index[i];
        j = cgs__entry(table, slot);
        *x = (table->cumulated[j + 1] - table->cumulated[j]) * (*x >> 16) + slot - table->cumulated[j];
        if (*x < (uint64_t)1 << 31) *x = *x << 32 | cgs__unsigned(words, 4);
        symbols[i] = j == table->entries - 1 ? INT32_MIN : table->lowest + j;
        if (rows.inertia) {
            const int64_t e = given->expected, most = CGS__SIZE_CAP * e;
            int64_t size = most;
            if (symbols[i] != INT32_MIN) {
                size = (int64_t)CGS__ONE * (symbols[i] < 0 ? -(int64_t)symbols[i] : symbols[i]);
                if (size > most) size = most;
            }
            seen += CGS__ONE * size / (e + CGS__SIZE_OFFSET);
            expected += CGS__ONE * e / (e + CGS__SIZE_OFFSET);
            shift = cgs__table_shift(seen, expected);
        }
    }
    cgs__end(words);
    for (k = 0; k < states; k++) cgs__require(d, state[k] == (uint64_t)1 << 31, "a state does not end where it began");
}

static void cgs__read_stream(cgs__fields *f, const cgs__table *tables, cgs__rows rows, uint8_t *index, int32_t *symbols,
                             uint64_t count) {
    const uint64_t chunks = (count + CGS__CHUNK_SYMBOLS - 1) / CGS__CHUNK_SYMBOLS;
    uint64_t chunk, escape_bytes, i;
    uint32_t *words;
    cgs__fields escapes;
    if (!count) return;
    words = (uint32_t *)cgs__alloc(f->d, chunks, sizeof *words);
    for (chunk = 0; chunk < chunks; chunk++) {
        const uint64_t left = count - chunk * CGS__CHUNK_SYMBOLS;
        const uint64_t size = left < CGS__CHUNK_SYMBOLS ? left : (uint64_t)CGS__CHUNK_SYMBOLS;
        words[chunk] = (uint32_t)cgs__varint(f, 2, size / 2 + 5, "words of a chunk");
    }
    escape_bytes = cgs__varint(f, 0, CGS__MAX_ESCAPE_BYTES * count, "escape_bytes");
    for (chunk = 0; chunk < chunks; chunk++) {
        const uint64_t bytes = 4 * (uint64_t)words[chunk], first = chunk * CGS__CHUNK_SYMBOLS;
        cgs__fields part = cgs__fields_of(f->d, cgs__take(f, bytes), (size_t)bytes);
        cgs__read_chunk(&part, tables, rows, index, symbols, first,
                        chunk + 1 < chunks ? first + CGS__CHUNK_SYMBOLS : count);
    }
    cgs__release(f->d, words);
    escapes = cgs__fields_of(f->d, cgs__take(f, escape_bytes), (size_t)escape_bytes);
    for (i = 0; i < count; i++) {
        const cgs__table *table = tables + index[i];
        int64_t v, symbol;
        if (symbols[i] != INT32_MIN) continue;
        v = (int64_t)cgs__raw_varint(&escapes, CGS__MAX_ESCAPE_BYTES);
        symbol = v & 1 ? table->lowest - 1 - (v - 1) / 2 : table->lowest + table->entries - 1 + v / 2;
        cgs__require(f->d, symbol >= INT32_MIN && symbol <= INT32_MAX, "a symbol has more than 32 bits");
        symbols[i] = (int32_t)symbol;
    }
    cgs__end(&escapes);
}

/* ---- arrays of integers */

/* All arrays of a section, one behind the other, up to its end. */
static int32_t *cgs__read_arrays(cgs__fields *f, const uint32_t *sizes, int arrays) {
    cgs__decoder *d = f->d;
    uint8_t *settings = (uint8_t *)cgs__alloc(d, 2 * (uint64_t)arrays, 1), *index;
    uint64_t count = 0, at = 0, bits = 0, bit = 0, stream_bytes, i;
    cgs__fields stream;
    cgs__rows none = {1, 0};
    const uint8_t *low_parts;
    int32_t *values;
    int a, k;
    for (a = 0; a < arrays; a++) {
        settings[2 * a] = (uint8_t)cgs__between(d, cgs__unsigned(f, 1), 0, CGS__GAUSSIAN_COUNT - 1, "table of an array");
        settings[2 * a + 1] = (uint8_t)cgs__between(d, cgs__unsigned(f, 1), 0, CGS__MAX_LOW_BITS, "low_bits");
        count += sizes[a];
        bits += (uint64_t)sizes[a] * settings[2 * a + 1];
    }
    index = (uint8_t *)cgs__alloc(d, count + 1, 1);
    values = (int32_t *)cgs__alloc(d, count + 1, sizeof *values);
    for (a = 0; a < arrays; at += sizes[a++]) memset(index + at, settings[2 * a], sizes[a]);
    stream_bytes = cgs__varint(f, 0, f->size - f->at, "stream_bytes");
    stream = cgs__fields_of(d, cgs__take(f, stream_bytes), (size_t)stream_bytes);
    cgs__read_stream(&stream, d->gaussian, none, index, values, count);
    cgs__end(&stream);
    low_parts = cgs__take(f, (bits + 7) / 8);
    cgs__end(f);
    for (a = 0, at = 0; a < arrays; a++) {
        const int low_bits = settings[2 * a + 1];
        for (i = 0; i < sizes[a]; i++, at++) {
            int64_t low = 0;
            for (k = 0; k < low_bits; k++, bit++) low = low << 1 | (low_parts[bit / 8] >> (7 - bit % 8) & 1);
            low += values[at] * ((int64_t)1 << low_bits) - (((int64_t)1 << low_bits) >> 1);
            cgs__require(d, low >= INT32_MIN && low <= INT32_MAX, "an element has more than 32 bits");
            values[at] = (int32_t)low;
        }
    }
    for (; bit % 8; bit++)
        cgs__require(d, !(low_parts[bit / 8] >> (7 - bit % 8) & 1), "a bit behind the last low part is not zero");
    cgs__release(d, index);
    cgs__release(d, settings);
    return values;
}

static void cgs__make_table(cgs__decoder *d, cgs__table *table, const int32_t *differences, uint32_t *cumulated) {
    static const uint64_t mantissas[] = {1024, 1116, 1217, 1327, 1448, 1579, 1722, 1878};
    const int m = table->entries;
    uint64_t w[CGS__MAX_HYPER_SYMBOLS + 1] = {0}, sum = 0, missing = 65536;
    int64_t level = 0, largest = -1;
    int j, first = 0;
    for (j = 0; j < m; j++) {
        level = j == m - 1 ? differences[j] : level + differences[j];
        cgs__require(d, level >= 0 && level <= 127, "a level of a table");
        if (level > largest) largest = level, first = j;
        sum += w[j] = mantissas[level % 8] << (level >> 3);
    }
    for (j = 0; j < m; j++) missing -= w[j] = 1 + w[j] * (uint64_t)(65536 - m) / sum;
    w[first] += missing;
    for (j = 0; j < m; j++) cumulated[j + 1] = cumulated[j] + (uint32_t)w[j];
    table->cumulated = cumulated;
}

static void cgs__read_tables(cgs__decoder *d) {
    cgs__fields f = cgs__open(d, CGS__TABLES);
    uint32_t count = 0, entries = 0, *cumulated, i;
    int32_t *differences;
    cgs__table *tables;
    int g;
    for (g = 0; g < d->scene->groups; g++)
        if (!d->scene->group[g].context) count += (uint32_t)cgs__width(d->scene, g);
    tables = (cgs__table *)cgs__alloc(d, count + 1, sizeof *tables);
    for (i = 0; i < count; i++) {
        tables[i].entries = (int32_t)cgs__varint(&f, 2, CGS__MAX_HYPER_SYMBOLS + 1, "entries of a table");
        tables[i].lowest = (int32_t)cgs__signed(&f, 9, CGS__MAX_SYMBOL, "lowest symbol of a table");
        entries += (uint32_t)tables[i].entries;
    }
    if (!count) {
        cgs__end(&f);
        return;
    }
    differences = cgs__read_arrays(&f, &entries, 1);
    cumulated = (uint32_t *)cgs__alloc(d, (uint64_t)entries + count, sizeof *cumulated);
    for (i = 0, entries = 0; i < count; i++) {
        cgs__make_table(d, tables + i, differences + entries, cumulated);
        entries += (uint32_t)tables[i].entries;
        cumulated += tables[i].entries + 1;
    }
    for (g = 0; g < d->scene->groups; g++) {
        if (d->scene->group[g].context) continue;
        d->tables[g] = tables;
        tables += cgs__width(d->scene, g);
    }
    cgs__release(d, differences);
}

/* ---- networks */

static cgs__network *cgs__read_network_head(cgs__fields *f, int group) {
    const cgs_scene *s = f->d->scene;
    const cgs_group *g = s->group + group;
    const int inputs = cgs__inputs(s, group), with_rows = s->version >= CGS__FIRST_WITH_ROWS;
    cgs__network *n = (cgs__network *)cgs__alloc(f->d, 1, sizeof *n);
    int flags, i;
    n->layers = (int)cgs__varint(f, 1, CGS__MAX_LAYERS, "layers");
    flags = (int)cgs__unsigned(f, 1);
    cgs__require(f->d, !(flags & ~((n->layers > 1) | (with_rows && g->channels > 1) << 1)), "flags of a network");
    n->skip = flags & 1, n->has_chain = flags >> 1;
    for (i = 0; i < n->layers; i++) {
        cgs__layer *layer = n->layer + i;
        const int is_last = i == n->layers - 1;
        layer->outputs = (int)cgs__varint(f, 1, CGS__MAX_LAYER_WIDTH, "width of a layer");
        layer->inputs = i ? layer[-1].outputs + (is_last && n->skip ? inputs : 0) : inputs;
        flags = (int)cgs__unsigned(f, 1);
        layer->shift = flags & 31, layer->adds = flags >> 6 & 1, layer->rectify = flags >> 7;
        cgs__require(f->d, layer->shift <= CGS__MAX_SHIFT && !(flags & 32), "flags of a layer");
        if (layer->adds)
            cgs__require(f->d, i && !is_last && layer->outputs == layer[-1].inputs, "a layer adds what it cannot");
        if (is_last) cgs__require(f->d, layer->outputs == 2 * cgs__width(s, group), "outputs of a network");
    }
    if (cgs__sees(s, group, group))
        n->follow_shift = (int)cgs__between(f->d, cgs__unsigned(f, 1), 0, CGS__MAX_SHIFT, "follow_shift");
    if (with_rows) n->inertia = (int)cgs__between(f->d, cgs__unsigned(f, 1), 0, CGS__MAX_INERTIA, "inertia");
    return n;
}

static int64_t cgs__largest(const int32_t *values, uint64_t count) {
    int64_t largest = 0;
    uint64_t i;
    for (i = 0; i < count; i++) {
        const int64_t size = values[i] < 0 ? -(int64_t)values[i] : values[i];
        if (size > largest) largest = size;
    }
    return largest;
}

static void cgs__read_networks(cgs__decoder *d, uint32_t anchors) {
    const cgs_scene *s = d->scene;
    cgs__fields f = cgs__open(d, CGS__NETWORKS);
    uint32_t sizes[CGS_MAX_GROUPS * (4 * CGS__MAX_LAYERS + 2)] = {0};
    uint64_t elements = 0, weights = 0;
    int32_t *values;
    int arrays = 0, g, i;
    for (g = 0; g < s->groups; g++) {
        const int channels = s->group[g].channels;
        if (!s->group[g].context) continue;
        d->network[g] = cgs__read_network_head(&f, g);
        for (i = 0; i < d->network[g]->layers; i++) {
            const cgs__layer *layer = d->network[g]->layer + i;
            const uint64_t upper = ((unsigned)layer->outputs + 1) / 2, lower = (unsigned)layer->outputs - upper;
            weights += (uint64_t)layer->inputs * (unsigned)layer->outputs;
            elements += ((uint64_t)layer->inputs + 1) * (unsigned)layer->outputs;
            cgs__require(d, elements <= CGS__MAX_WEIGHTS, "too many weights");
            sizes[arrays++] = (uint32_t)(upper * (unsigned)layer->inputs);
            sizes[arrays++] = (uint32_t)(lower * (unsigned)layer->inputs);
            sizes[arrays++] = (uint32_t)upper;
            sizes[arrays++] = (uint32_t)lower;
        }
        if (cgs__sees(s, g, g)) elements += sizes[arrays++] = (uint32_t)channels;
        if (d->network[g]->has_chain) elements += sizes[arrays++] = (uint32_t)(channels * (channels - 1) / 2);
    }
    cgs__require(d, elements <= CGS__MAX_WEIGHTS, "too many weights");
    cgs__check(d, CGS__NETWORK_PRODUCTS, anchors * weights, "more products than the file's length allows");
    if (!arrays) {
        cgs__end(&f);
        return;
    }
    values = cgs__read_arrays(&f, sizes, arrays);
    for (g = 0; g < s->groups; g++) {
        cgs__network *n = d->network[g];
        const int channels = s->group[g].channels;
        if (!n) continue;
        for (i = 0; i < n->layers; i++) { /* the halves of an array lie side by side */
            cgs__layer *layer = n->layer + i;
            const uint64_t count = (uint64_t)layer->inputs * (unsigned)layer->outputs;
            layer->weight = values, values += count;
            layer->bias = values, values += layer->outputs;
            cgs__require(d, cgs__largest(layer->weight, count) * layer->inputs < (int64_t)1 << 29, "a weight");
            cgs__require(d, cgs__largest(layer->bias, (uint64_t)layer->outputs) < (int64_t)1 << 31, "a bias");
        }
        if (cgs__sees(s, g, g)) {
            n->follow = values, values += channels;
            cgs__require(d, cgs__largest(n->follow, (uint64_t)channels) < CGS__FOLLOW_LIMIT, "an element of follow");
        }
        if (n->has_chain) {
            const int length = channels * (channels - 1) / 2;
            n->chain = values, values += length;
            cgs__require(d, cgs__largest(n->chain, (uint64_t)length) < CGS__CHAIN_LIMIT, "an element of chain");
        }
    }
}

/* Room for what `cgs__evaluate` needs of a network: three rows. */
static int cgs__widest(const cgs__network *n) {
    int widest = 0, i;
    for (i = 0; i < n->layers; i++) {
        if (n->layer[i].inputs > widest) widest = n->layer[i].inputs;
        if (n->layer[i].outputs > widest) widest = n->layer[i].outputs;
    }
    return widest;
}

/* Outputs of a network for a row of inputs, which are clamped. scratch: [3, widest]. */
static const int32_t *cgs__evaluate(const cgs__network *n, int32_t *inputs, int32_t *scratch, int widest) {
    int32_t *before = scratch, *x = scratch + widest, *y = scratch + 2 * (size_t)widest;
    const int count = n->layer[0].inputs;
    int i, o, k;
    for (k = 0; k < count; k++) x[k] = inputs[k] = cgs__activation(inputs[k]);
    for (i = 0; i < n->layers; i++) {
        const cgs__layer *layer = n->layer + i;
        int32_t *swap = before;
        if (i && i == n->layers - 1 && n->skip)
            memcpy(x + layer->inputs - count, inputs, (size_t)count * sizeof *x);
        for (o = 0; o < layer->outputs; o++) {
            const int32_t *w = layer->weight + (size_t)o * (unsigned)layer->inputs;
            int64_t sum = 0;
            for (k = 0; k < layer->inputs; k++) sum += (int64_t)w[k] * x[k];
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
static const cgs__head CGS__PAIRED[] = {{"geometry", 0, 10, 1}, {"appearance", 1, 4, 1}};
static const cgs__head CGS__SEPARATE[] = {
    {"translation", 0, 3, 1}, {"covariance", 0, 7, 1}, {"opacity", 1, 1, 1}, {"color", 1, 3, 2}};
static const char *const CGS__OUTER[] = {"input_weight", "input_bias", "output_weight", "output_bias", "skip_weight"};
static const char *const CGS__INNER[] = {"weight1", "bias1", "weight2", "bias2"};

typedef struct {
    char name[CGS__MAX_NAME_BYTES + 1];
    int rank;
    uint32_t side[CGS__MAX_RANK];
} cgs__shape;

static void cgs__shape_of(cgs__shape *shape, const char *text, const char *tensor, int block, int rows, int columns) {
    if (block < 0) snprintf(shape->name, sizeof shape->name, "%s.%s", text, tensor);
    else snprintf(shape->name, sizeof shape->name, "%s.blocks.%d.%s", text, block, tensor);
    shape->rank = rows ? 2 : 1;
    shape->side[0] = (uint32_t)(rows ? rows : columns);
    shape->side[1] = (uint32_t)columns;
}

static int cgs__has_residuals(const cgs_scene *s) {
    int g, found = 0;
    for (g = 0; g < s->groups; g++) found |= s->group[g].role == CGS_RESIDUAL;
    return found;
}

/* The tensors of a scene in the order of version 5; how many there are. */
static int cgs__expected_tensors(const cgs_scene *s, cgs__shape *shapes) {
    const cgs__head *head = s->separate_heads ? CGS__SEPARATE : CGS__PAIRED;
    const int heads = s->separate_heads ? 4 : 2, h = s->width;
    int count = 0, i, b, k;
    for (i = 0; i < heads; i++, head++) {
        const int inputs = s->reference_dim + 4 * head->sees_view + s->residual_dim, o = head->outputs;
        const int rows[] = {inputs, 0, h, 0, inputs}, columns[] = {h, h, o, o, o};
        for (k = 0; k < 5; k++) cgs__shape_of(shapes + count++, head->name, CGS__OUTER[k], -1, rows[k], columns[k]);
        for (b = 0; b < head->blocks; b++)
            for (k = 0; k < 4; k++) cgs__shape_of(shapes + count++, head->name, CGS__INNER[k], b, k % 2 ? 0 : h, h);
    }
    if (!cgs__has_residuals(s)) {
        cgs__shape_of(shapes + count, "", "", -1, s->coupled_primitives, s->residual_dim);
        strcpy(shapes[count++].name, "residuals");
    }
    return count;
}

static uint64_t cgs__elements(const cgs__shape *shape) {
    uint64_t count = 1;
    int i;
    for (i = 0; i < shape->rank; i++) count *= shape->side[i];
    return count;
}

static void cgs__read_name(cgs__fields *f, cgs__shape *shape, const cgs__shape *previous) {
    const size_t before = previous ? strlen(previous->name) : 0;
    const uint64_t shared = cgs__varint(f, 0, before, "shared bytes of a name");
    const uint64_t rest = cgs__varint(f, 0, CGS__MAX_NAME_BYTES - shared, "bytes of a name");
    const uint8_t *text = cgs__take(f, rest);
    cgs__require(f->d, shared + rest > 0, "a name without bytes");
    if (shared) memcpy(shape->name, previous->name, (size_t)shared);
    memcpy(shape->name + shared, text, (size_t)rest);
    cgs__require(f->d, shared == before || !rest || previous->name[shared] != (char)text[0],
                 "a name shares fewer bytes than it could");
    cgs__require(f->d, cgs__is_text((const uint8_t *)shape->name, (size_t)(shared + rest)), "a name is not UTF-8");
    /* No name of the list has a NUL, so that the file is refused in any case. */
    cgs__require(f->d, !memchr(shape->name, 0, (size_t)(shared + rest)), "a tensor is not of the list");
}

static void cgs__read_heads(cgs__decoder *d, uint32_t coupled) {
    cgs_scene *s = d->scene;
    cgs__fields f = cgs__open(d, CGS__HEADS);
    const int is_named = s->version < CGS__FIRST_WITH_ROWS;
    cgs__shape *expected = (cgs__shape *)cgs__alloc(d, CGS_MAX_TENSORS, sizeof *expected), *stored = expected;
    int exponents[256], count, i, k;
    uint32_t sizes[256] = {0};
    uint64_t elements = 0;
    int32_t *values;
    s->tensors = cgs__expected_tensors(s, expected);
    count = is_named ? (int)cgs__varint(&f, 0, 256, "number of tensors") : s->tensors;
    if (is_named) stored = (cgs__shape *)cgs__alloc(d, 256, sizeof *stored);
    for (i = 0; i < count; i++) {
        if (is_named) {
            cgs__read_name(&f, stored + i, i ? stored + i - 1 : NULL);
            for (k = 0; k < i; k++)
                cgs__require(d, strcmp(stored[k].name, stored[i].name) != 0, "two tensors have the same name");
            stored[i].rank = (int)cgs__varint(&f, 0, CGS__MAX_RANK, "rank of a tensor");
            for (k = 0; k < stored[i].rank; k++)
                stored[i].side[k] = (uint32_t)cgs__varint(&f, 0, CGS__MAX_LAYER_WIDTH, "side of a tensor");
        }
        exponents[i] = (int)cgs__signed(&f, 9, CGS__MAX_EXPONENT, "exponent of a tensor");
        cgs__require(d, cgs__elements(stored + i) <= CGS__MAX_WEIGHTS, "too many elements of tensors");
        elements += sizes[i] = (uint32_t)cgs__elements(stored + i);
    }
    cgs__require(d, elements <= CGS__MAX_WEIGHTS, "too many elements of tensors");
    cgs__check(d, CGS__HEAD_PRODUCTS, coupled * elements, "more products than the file's length allows");
    cgs__require(d, count == s->tensors, "a tensor is missing, or not of the list");
    values = cgs__read_arrays(&f, sizes, count);
    for (i = 0; i < count; values += sizes[i++]) {
        for (k = 0; k < count && strcmp(expected[k].name, stored[i].name); k++) continue;
        cgs__require(d, k < count, "a tensor is not of the list");
        cgs__require(d, stored[i].rank == expected[k].rank && stored[i].side[0] == expected[k].side[0]
                            && (stored[i].rank < 2 || stored[i].side[1] == expected[k].side[1]),
                     "a tensor has another shape");
        s->tensor[k].rows = stored[i].rank == 2 ? stored[i].side[0] : 1;
        s->tensor[k].columns = stored[i].side[stored[i].rank - 1];
        s->tensor[k].exponent = exponents[i];
        s->tensor[k].values = values;
    }
    if (is_named) cgs__release(d, stored);
    cgs__release(d, expected);
}

/* ---- arithmetic code */

typedef struct {
    const cgs__decoder *d;
    const uint8_t *data;
    uint64_t size, position, low, high, code;
} cgs__coder;

static uint64_t cgs__next_byte(cgs__coder *c) {
    const uint64_t at = c->position++;
    return at < c->size ? c->data[at] : 0;
}

static void cgs__start(cgs__coder *c, const cgs__decoder *d, const uint8_t *data, size_t size) {
    int i;
    c->d = d, c->data = data, c->size = size, c->position = 0;
    c->low = c->code = 0, c->high = ((uint64_t)1 << 48) - 1;
    for (i = 0; i < 6; i++) c->code = c->code << 8 | cgs__next_byte(c);
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

/* Bytes of the code; refused if it does not end as an encoder ends it. */
static uint64_t cgs__finish(cgs__coder *c, cgs__decoder *d) {
    cgs__require(d, c->code == ((c->low >> 40) + 1) << 40, "the code does not end as an encoder ends it");
    return c->position - 5;
}

/* floor(2^64 a b / 2^128) of two fractions of 64 bits. */
static uint64_t cgs__multiply_high(uint64_t a, uint64_t b) {
    const uint64_t low = 0xffffffffu, middle = (a >> 32) * (b & low) + ((a & low) * (b & low) >> 32);
    return (a >> 32) * (b >> 32) + (middle >> 32) + (((middle & low) + (a & low) * (b >> 32)) >> 32);
}

/* floor((65536 E + floor((2^64 + E) / 2)) / (2^64 + E)), E < 2^64. */
static uint16_t cgs__squashed(uint64_t e) {
    uint64_t high = e >> 48, low = e << 16, quotient = 0; /* 65536 E in two words */
    uint64_t half = (e >> 1) + ((uint64_t)1 << 63);
    int bit;
    low += half, high += low < half;
    for (bit = 16; bit >= 0; bit--) { /* (2^64 + E) << bit */
        const uint64_t part_low = e << bit, part_high = ((uint64_t)1 << bit) + (bit ? e >> (64 - bit) : 0);
        if (high < part_high || (high == part_high && low < part_low)) continue;
        high -= part_high + (low < part_low);
        low -= part_low;
        quotient |= (uint64_t)1 << bit;
    }
    return (uint16_t)quotient;
}

static void cgs__make_arithmetic(cgs__decoder *d) {
    uint64_t e = 18374827034086858296u;
    int x, i, n;
    d->squash[2048] = 32768; /* E(0) = 2^64 */
    for (x = 1; x <= 2048; x++, e = cgs__multiply_high(18374827034086858296u, e)) {
        d->squash[2048 - x] = cgs__squashed(e);
        if (x < 2048) d->squash[2048 + x] = (uint16_t)(65536 - d->squash[2048 - x]);
    }
    for (i = 0, x = 0; i < 4096; i++) {
        while (x < 4096 && d->squash[x] < 16 * i + 8) x++;
        d->stretch[i] = (int16_t)cgs__clamp(x - 2048, -2047, 2047);
    }
    for (n = 0; n < 1024; n++) {
        d->rate[n] = (uint16_t)(655360 / (10 * n + 16));
        d->confidence[n] = (int16_t)(256 * n / (n + 3));
    }
}

/* States: a probability of 22 bits, then a count of 10. */
static uint32_t *cgs__new_states(cgs__decoder *d, uint32_t count) {
    uint32_t *states = (uint32_t *)cgs__alloc(d, count, sizeof *states), i;
    for (i = 0; i < count; i++) states[i] = (uint32_t)1 << 31;
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
    cgs__mixer m;
    int i;
    memset(&m, 0, sizeof m);
    m.inputs = inputs, m.limit = limit, m.rate = rate;
    m.states = cgs__new_states(d, states);
    m.weights = (int64_t *)cgs__alloc(d, (uint64_t)sets * (unsigned)(inputs + 1), sizeof *m.weights);
    m.refinement = (int32_t *)cgs__alloc(d, 33 * (uint64_t)refinements, sizeof *m.refinement);
    for (i = 0; i < sets * (inputs + 1); i++) m.weights[i] = i % (inputs + 1) < inputs ? initial : 0;
    for (i = 0; i < 33 * refinements; i++)
        m.refinement[i] = d->squash[128 * (i % 33) < 4095 ? 128 * (i % 33) : 4095];
    return m;
}

static void cgs__release_mixer(cgs__decoder *d, cgs__mixer *m) {
    cgs__release(d, m->states);
    cgs__release(d, m->weights);
    cgs__release(d, m->refinement);
}

static int cgs__mix(cgs__coder *c, cgs__mixer *m, int first, int second, int refine) {
    const cgs__decoder *d = c->d;
    int64_t *a = m->weights + first * (m->inputs + 1), *b = m->weights + second * (m->inputs + 1), l[8];
    int32_t *r = m->refinement + 33 * refine;
    int64_t sum_a = 0, sum_b = 0, logit_a, logit_b, logit, place, share, refined, error_a, error_b, target;
    int bit, k;
    for (k = 0; k <= m->inputs; k++) {
        const uint32_t state = k < m->inputs ? m->states[m->at[k]] : 0;
        l[k] = k < m->inputs ? cgs__right((int64_t)d->stretch[state >> 20] * d->confidence[state & 1023], 8) : 256;
        sum_a += a[k] * l[k];
        sum_b += b[k] * l[k];
    }
    logit_a = cgs__clamp(cgs__right(sum_a, 16), -2047, 2047);
    logit_b = cgs__clamp(cgs__right(sum_b, 16), -2047, 2047);
    logit = cgs__right(logit_a + logit_b, 1);
    place = 32 * (logit + 2048);
    r += place >> 12;
    share = place & 4095;
    refined = (r[0] * (4096 - share) + r[1] * share) >> 12;
    bit = cgs__decide(c, (uint32_t)cgs__clamp((d->squash[logit + 2048] + refined) >> 1, 20, 65516));
    target = 65535 * bit;
    error_a = (target - d->squash[logit_a + 2048]) * m->rate;
    error_b = (target - d->squash[logit_b + 2048]) * m->rate;
    for (k = 0; k <= m->inputs; k++) {
        a[k] += cgs__right(l[k] * error_a + 32768, 16);
        b[k] += cgs__right(l[k] * error_b + 32768, 16);
    }
    for (k = 0; k < m->inputs; k++) cgs__learn(d, m->states + m->at[k], bit, (uint32_t)m->limit);
    r[0] += (int32_t)cgs__right((target - r[0]) * (4096 - share), 18);
    r[1] += (int32_t)cgs__right((target - r[1]) * share, 18);
    return bit;
}

/* ---- positions: the walk of the octree */

/* References to nodes: the index of a waiting node, or -2 - index of a single anchor, or -1 for none. */
typedef struct {
    uint32_t count;
    int32_t *place;      /* [count, 3] */
    int32_t *neighbours; /* [count, 27] references */
    uint8_t *siblings;   /* [count] sum of 2^i over the occupied children i of the parent */
    uint8_t *index;      /* [count] its own place among the parent's eight */
} cgs__level;

typedef struct {
    cgs__decoder *d;
    cgs__coder coder;
    cgs__mixer occupancy, single;
    uint32_t *direct;
    int32_t *offsets; /* [anchors, 3] in the order of the walk */
    uint32_t anchors, found, waiting;
    int depth;
    uint64_t occupied, unknown; /* of the 4 x 4 x 4 cells around the node at hand */
    uint64_t cells[27][256];    /* that the children of neighbour j take, by its occupancy */
    uint64_t around[8];
    uint8_t faces[8][6], touching[8][7], step_node[8][27], step_child[8][27];
} cgs__walk;

static void cgs__make_grid(cgs__walk *w) {
    int c, j, k, o, axis;
    for (j = 0; j < 27; j++) {
        const int delta[3] = {j / 9 - 1, j / 3 % 3 - 1, j % 3 - 1};
        for (c = 0; c < 8; c++) {
            int node = 0, child = 0, cell = 0, inside = 1;
            for (axis = 0; axis < 3; axis++) {
                const int own = c >> (2 - axis) & 1, place = 2 * delta[axis] + own + 1, moved = own + delta[axis];
                inside &= place >= 0 && place < 4;
                cell = 4 * cell + place;
                node = 3 * node + (moved < 0 ? 0 : moved < 2 ? 1 : 2);
                child = 2 * child + (moved & 1);
            }
            w->step_node[c][j] = (uint8_t)node;
            w->step_child[c][j] = (uint8_t)child;
            for (o = 0; inside && o < 256; o++)
                if (o >> c & 1) w->cells[j][o] |= (uint64_t)1 << cell;
            cell = 0;
            for (axis = 0; axis < 3; axis++) cell = 4 * cell + (c >> (2 - axis) & 1) + 1 + delta[axis];
            if (j != 13) w->around[c] |= (uint64_t)1 << cell;
        }
    }
    for (c = 0; c < 8; c++) {
        static const int units[3] = {16, 4, 1}, nodes[3] = {9, 3, 1};
        static const int parts[7] = {1, 2, 4, 3, 5, 6, 7}; /* x, y, z, xy, xz, yz, xyz */
        const int own = 16 * (c >> 2) + 4 * (c >> 1 & 1) + (c & 1) + 21;
        for (k = 0; k < 6; k++) w->faces[c][k] = (uint8_t)(own + (k % 2 ? units[k / 2] : -units[k / 2]));
        for (k = 0; k < 7; k++) {
            int node = 13;
            for (axis = 0; axis < 3; axis++)
                if (parts[k] >> axis & 1) node += c >> (2 - axis) & 1 ? nodes[axis] : -nodes[axis];
            w->touching[c][k] = (uint8_t)node;
        }
    }
}

static cgs__level cgs__new_level(cgs__decoder *d, uint32_t count) {
    cgs__level level;
    const uint64_t room = (uint64_t)count + 1;
    level.count = count;
    level.place = (int32_t *)cgs__alloc(d, 3 * room, sizeof *level.place);
    level.neighbours = (int32_t *)cgs__alloc(d, 27 * room, sizeof *level.neighbours);
    level.siblings = (uint8_t *)cgs__alloc(d, room, 1);
    level.index = (uint8_t *)cgs__alloc(d, room, 1);
    memset(level.neighbours, 0xff, 27 * (size_t)room * sizeof *level.neighbours);
    return level;
}

static void cgs__release_level(cgs__decoder *d, cgs__level *level) {
    cgs__release(d, level->place);
    cgs__release(d, level->neighbours);
    cgs__release(d, level->siblings);
    cgs__release(d, level->index);
}

/* Which child of its node, `height` bits above the voxels, holds a single anchor. */
static int cgs__child_holding(const cgs__walk *w, int32_t anchor, int height) {
    const int32_t *v = w->offsets + 3 * (size_t)anchor;
    return 4 * (v[0] >> height & 1) + 2 * (v[1] >> height & 1) + (v[2] >> height & 1);
}

static int cgs__cell_state(uint64_t occupied, uint64_t unknown, int cell) { /* 0 empty, 1 occupied, 2 unknown */
    return (int)(occupied >> cell & 1) + 2 * (int)(unknown >> cell & 1);
}

static int cgs__count_around(const cgs__walk *w, int child, uint64_t cells, int most) {
    const int count = cgs__ones(cells & w->around[child]);
    return count < most ? count : most;
}

static int cgs__least(int a, int b) { return a < b ? a : b; }

static void cgs__look_around(cgs__walk *w, const cgs__level *level, uint32_t node, int height, const uint8_t *known) {
    int j;
    w->occupied = w->unknown = 0;
    for (j = 0; j < 27; j++) {
        const int32_t reference = level->neighbours[27 * (size_t)node + (unsigned)j];
        if (reference == -1 || j == 13) continue;
        if (reference > (int32_t)node) w->unknown |= w->cells[j][255];
        else if (reference >= 0) w->occupied |= w->cells[j][known[reference]];
        else w->occupied |= w->cells[j][1 << cgs__child_holding(w, -2 - reference, height)];
    }
}

static int cgs__read_occupancy(cgs__walk *w, const cgs__level *level, uint32_t node, int step) {
    static const uint32_t base[7] = {0, 8192, 37352, 42472, 43772, 54524, 70908};
    static const int face_nodes[6] = {4, 22, 10, 16, 12, 14};
    const int32_t *neighbours = level->neighbours + 27 * (size_t)node, *place = level->place + 3 * (size_t)node;
    const int height = w->depth - 1 - step, parents = level->siblings[node], index = level->index[node];
    const int siblings = cgs__ones((uint64_t)parents) - 1, bits = place[0] | place[1] | place[2];
    int grid = height < 3 && !(bits & ((1 << (3 - height)) - 1)), scale_grid, near = 0, children = 0, taken = 0, c, k;
    if (height == 0 && !(bits & 1)) grid += 2;
    scale_grid = 4 * cgs__least(height, 7) + grid;
    for (k = 0; k < 6; k++) near |= (neighbours[face_nodes[k]] != -1) << k;
    for (c = 0; c < 8; c++) {
        const uint64_t here = w->occupied | w->cells[13][children];
        const uint64_t later = w->unknown | w->cells[13][255 & ~((1 << c) - 1)];
        const int few = cgs__least(taken, 4), prefix = (1 << c) + children;
        const int occupied = cgs__count_around(w, c, here, 12), open = cgs__count_around(w, c, later, 19);
        uint32_t *at = w->occupancy.at;
        int faces = 0, touching = 0, bit = 1;
        if (taken + 8 - c > (height ? 1 : 2)) {
            for (k = 0; k < 6; k++) faces = 3 * faces + cgs__cell_state(here, later, w->faces[c][k]);
            for (k = 0; k < 7; k++) touching |= (neighbours[w->touching[c][k]] != -1) << k;
            at[0] = base[0] + (uint32_t)(256 * scale_grid + prefix);
            at[1] = base[1] + (uint32_t)((8 * faces + c) * 5 + few);
            at[2] = base[2] + (uint32_t)((8 * touching + c) * 5 + few);
            at[3] = base[3] + (uint32_t)((20 * occupied + open) * 5 + few);
            at[4] = base[4] + (uint32_t)(((8 * step + siblings) * 8 + c) * 8 + taken);
            at[5] = base[5] + (uint32_t)(256 * near + prefix);
            at[6] = base[6] + (uint32_t)((8 * parents + index) * 8 + c);
            bit = cgs__mix(&w->coder, &w->occupancy, 8 * step + c, 168 + 5 * occupied + few, 8 * scale_grid + c);
        }
        children |= bit << c;
        taken += bit;
    }
    w->occupied |= w->cells[13][children];
    return children;
}

/* The last `bits` bits per axis of an anchor that is alone in its node. */
static void cgs__read_single(cgs__walk *w, int32_t x, int32_t y, int32_t z, int bits, const int sides[3]) {
    int32_t *v = w->offsets + 3 * (size_t)w->found++;
    const int low = cgs__least(bits, 4);
    int zeros = 1, coarse = 0, axis, b, half;
    v[0] = x, v[1] = y, v[2] = z;
    for (b = bits - 1; b >= 4; b--) {
        for (axis = 0; axis < 3; axis++) {
            int bit;
            if (b == bits - 1) bit = cgs__decide_by(&w->coder, w->direct + 3 * sides[axis] + axis);
            else if (b == bits - 2)
                bit = cgs__decide_by(&w->coder, w->direct + 27 + 3 * (2 * sides[axis] + (v[axis] & 1)) + axis);
            else bit = cgs__decide(&w->coder, 32768);
            v[axis] = 2 * v[axis] + bit;
        }
    }
    for (axis = 0; axis < 3; axis++) v[axis] <<= low;
    for (half = 0; half < 2; half++) {
        for (axis = 0; axis < 3; axis++) {
            for (b = cgs__least(low, 2 * half + 2) - 1; b >= 2 * half; b--) {
                const int state = ((((half * 3 + axis) * 2 + b % 2) * 2 + zeros) * 2 + coarse) * 5 + low;
                const int bit = cgs__decide_by(&w->coder, w->direct + 128 + state);
                v[axis] |= bit << b;
                if (bit) zeros = 0;
            }
        }
        coarse = zeros;
    }
}

static void cgs__read_singles(cgs__walk *w, const cgs__level *level, uint32_t node, int step, int children,
                              int32_t *references) {
    static const uint32_t base[5] = {0, 1344, 2384, 5300, 7348};
    const int32_t *near = level->neighbours + 27 * (size_t)node, *place = level->place + 3 * (size_t)node;
    const int height = w->depth - 1 - step, taken = cgs__ones((uint64_t)children);
    int neighbours = 0, crowds = 0, crowded = 0, c, j, k;
    for (j = 0; j < 27; j++) {
        neighbours += j != 13 && near[j] != -1;
        crowds += j != 13 && near[j] >= 0;
    }
    for (c = 0; c < 8; c++) {
        int is_single = height == 0, sides[3];
        if (!(children >> c & 1)) continue;
        if (height > 0 && taken > 1) {
            const int occupied = cgs__count_around(w, c, w->occupied, 12), open = cgs__count_around(w, c, w->unknown, 19);
            const int crowd = cgs__least(crowded, 3), three = cgs__least(taken, 3), last = !(children >> (c + 1));
            uint32_t *at = w->single.at;
            at[0] = base[0] + (uint32_t)((8 * step + taken - 1) * 8 + 2 * crowd + last);
            at[1] = base[1] + (uint32_t)((20 * occupied + open) * 4 + three);
            at[2] = base[2] + (uint32_t)((27 * neighbours + crowds) * 4 + three);
            at[3] = base[3] + (uint32_t)(8 * children + c);
            at[4] = base[4] + (uint32_t)((13 * crowds + occupied) * 8 + taken - 1);
            is_single = cgs__mix(&w->coder, &w->single, 8 * step + taken - 1, 168 + 20 * occupied + open, 4 * step + crowd);
        }
        if (!is_single) {
            crowded++;
            references[c] = (int32_t)w->waiting++;
            continue;
        }
        cgs__require(w->d, w->found < w->anchors, "more anchors than the scene has");
        references[c] = -2 - (int32_t)w->found;
        for (k = 0; k < 3; k++)
            sides[k] = 3 * cgs__cell_state(w->occupied, w->unknown, w->faces[c][2 * k])
                     + cgs__cell_state(w->occupied, w->unknown, w->faces[c][2 * k + 1]);
        cgs__read_single(w, 2 * place[0] + (c >> 2), 2 * place[1] + (c >> 1 & 1), 2 * place[2] + (c & 1), height, sides);
    }
}

/* The nodes that wait for the next step, with references to what lies around them. */
static cgs__level cgs__next_level(cgs__walk *w, const cgs__level *level, int height, const uint8_t *known,
                                  const int32_t *children) {
    cgs__level next = cgs__new_level(w->d, w->waiting);
    uint32_t node, to = 0;
    int c, j;
    for (node = 0; node < level->count; node++) {
        const int32_t *from = level->place + 3 * (size_t)node;
        for (c = 0; c < 8; c++) {
            if (children[8 * (size_t)node + (unsigned)c] < 0) continue;
            next.place[3 * (size_t)to] = 2 * from[0] + (c >> 2);
            next.place[3 * (size_t)to + 1] = 2 * from[1] + (c >> 1 & 1);
            next.place[3 * (size_t)to + 2] = 2 * from[2] + (c & 1);
            next.siblings[to] = known[node];
            next.index[to] = (uint8_t)c;
            for (j = 0; j < 27; j++) {
                const int32_t reference = level->neighbours[27 * (size_t)node + w->step_node[c][j]];
                const int child = w->step_child[c][j];
                int32_t *found = next.neighbours + 27 * (size_t)to + j;
                if (reference >= 0) *found = children[8 * (size_t)reference + (unsigned)child];
                else if (reference != -1 && cgs__child_holding(w, -2 - reference, height) == child) *found = reference;
            }
            to++;
        }
    }
    return next;
}

static cgs__level cgs__walk_level(cgs__walk *w, cgs__level *level, int step) {
    cgs__decoder *d = w->d;
    const int height = w->depth - 1 - step;
    int32_t *children = (int32_t *)cgs__alloc(d, 8 * (uint64_t)level->count, sizeof *children);
    uint8_t *known = (uint8_t *)cgs__alloc(d, level->count, 1);
    cgs__level next;
    uint32_t node;
    memset(children, 0xff, 8 * (size_t)level->count * sizeof *children);
    w->waiting = 0;
    for (node = 0; node < level->count; node++) {
        cgs__look_around(w, level, node, height, known);
        known[node] = (uint8_t)cgs__read_occupancy(w, level, node, step);
        cgs__read_singles(w, level, node, step, known[node], children + 8 * (size_t)node);
        cgs__require(d, w->found + 2 * ((uint64_t)w->waiting + level->count - 1 - node) <= w->anchors,
                     "more anchors than the scene has");
    }
    next = cgs__next_level(w, level, height, known, children);
    cgs__release(d, children);
    cgs__release(d, known);
    cgs__release_level(d, level);
    return next;
}

/* Offsets [anchors, 3] in the order of the walk; the code's length is added to what was read of the fields. */
static int32_t *cgs__read_walk(cgs__fields *f, uint32_t anchors, int depth) {
    static const int nowhere[3] = {0, 0, 0};
    cgs__decoder *d = f->d;
    cgs__walk *w = (cgs__walk *)cgs__alloc(d, 1, sizeof *w);
    int32_t *offsets;
    w->d = d, w->anchors = anchors, w->depth = depth;
    w->offsets = offsets = (int32_t *)cgs__alloc(d, 3 * (uint64_t)anchors, sizeof *w->offsets);
    w->direct = cgs__new_states(d, 368);
    cgs__start(&w->coder, d, f->data + f->at, f->size - f->at);
    if (anchors == 1) {
        cgs__read_single(w, 0, 0, 0, depth, nowhere);
    } else {
        cgs__level level = cgs__new_level(d, 1);
        uint64_t nodes = 0;
        int step;
        cgs__make_grid(w);
        w->occupancy = cgs__new_mixer(d, 7, 87292, 168 + 65, 256, 16384, 400, 4);
        w->single = cgs__new_mixer(d, 5, 10156, 168 + 260, 84, 16384, 400, 4);
        level.neighbours[13] = 0;
        level.siblings[0] = 1;
        for (step = 0; step < depth && level.count; step++) {
            nodes += level.count;
            cgs__check(d, CGS__NODES, nodes, "more nodes than the file's length allows");
            level = cgs__walk_level(w, &level, step);
        }
        cgs__release_level(d, &level);
        cgs__release_mixer(d, &w->occupancy);
        cgs__release_mixer(d, &w->single);
    }
    cgs__require(d, w->found == anchors, "fewer anchors than the scene has");
    f->at += (size_t)cgs__finish(&w->coder, d);
    cgs__release(d, w->direct);
    cgs__release(d, w);
    return offsets;
}

static uint64_t cgs__morton(const int32_t *v) {
    uint64_t code = 0;
    int b, axis;
    for (b = CGS__MAX_DEPTH - 1; b >= 0; b--)
        for (axis = 0; axis < 3; axis++) code = code << 1 | (uint64_t)(v[axis] >> b & 1);
    return code;
}

static int cgs__by_code(const void *a, const void *b) {
    const uint64_t x = *(const uint64_t *)a, y = *(const uint64_t *)b;
    return x < y ? -1 : x > y;
}

/* Brings the offsets into canonical order, and counts the anchors of each level and those above it. */
static void cgs__order(cgs__decoder *d, uint32_t anchors, int depth) {
    uint64_t *codes = (uint64_t *)cgs__alloc(d, anchors, sizeof *codes);
    uint8_t *levels = (uint8_t *)cgs__alloc(d, anchors, 1);
    uint32_t next[CGS__MAX_DEPTH + 2] = {0}, i;
    int level, b, axis;
    for (i = 0; i < anchors; i++) codes[i] = cgs__morton(d->offsets + 3 * (size_t)i);
    qsort(codes, anchors, sizeof *codes, cgs__by_code);
    for (i = 0; i < anchors; i++) {
        uint64_t differs = i ? codes[i] ^ codes[i - 1] : 0;
        for (level = i ? depth + 1 : 0; differs; differs >>= 3) level--;
        cgs__require(d, level <= depth, "two anchors are in one place"); /* no walk gives that */
        levels[i] = (uint8_t)level;
        next[level + 1]++;
    }
    for (level = 0; level <= depth; level++) d->up_to_level[level] = next[level + 1] += next[level];
    for (i = 0; i < anchors; i++) {
        int32_t *v = d->offsets + 3 * (size_t)next[levels[i]]++;
        v[0] = v[1] = v[2] = 0;
        for (b = CGS__MAX_DEPTH - 1; b >= 0; b--)
            for (axis = 0; axis < 3; axis++) v[axis] = v[axis] << 1 | (int32_t)(codes[i] >> (3 * b + 2 - axis) & 1);
    }
    cgs__release(d, codes);
    cgs__release(d, levels);
}

static void cgs__read_positions(cgs__decoder *d) {
    cgs_scene *s = d->scene;
    const uint32_t anchors = s->total_anchors, least = (anchors + 3) / 4;
    int32_t smallest[3] = {INT32_MAX, INT32_MAX, INT32_MAX}, largest[3] = {0}, most = 0, *coordinates;
    int64_t origin[3];
    cgs__fields f;
    uint32_t i;
    int axis, depth = 0;
    if (!cgs__find(d, CGS__POSITIONS)) {
        d->section = cgs__name(CGS__GPCC);
        cgs__fail(d, CGS_MISSING_DEPENDENCY, "this decoder has no G-PCC");
    }
    f = cgs__open(d, CGS__POSITIONS);
    cgs__require(d, f.size >= least, "too few bytes for so many anchors");
    s->depth = (int)cgs__between(d, cgs__unsigned(&f, 1), 0, CGS__MAX_DEPTH, "depth");
    cgs__require(d, anchors <= (uint64_t)1 << (3 * s->depth), "more anchors than the octree has room for");
    for (axis = 0; axis < 3; axis++) origin[axis] = 16 * cgs__signed(&f, 4, (int64_t)1 << 27, "origin");
    d->offsets = cgs__read_walk(&f, anchors, s->depth);
    cgs__require(d, f.at <= f.size && f.size == (f.at > least ? f.at : least), "bytes are left over");
    while (f.at < f.size) cgs__require(d, !f.data[f.at++], "a byte behind the code is not zero");
    for (i = 0; i < 3 * anchors; i++) {
        const int32_t v = d->offsets[i];
        if (v < smallest[i % 3]) smallest[i % 3] = v;
        if (v > largest[i % 3]) largest[i % 3] = v;
        if (v > most) most = v;
    }
    while (most >> depth) depth++;
    cgs__require(d, depth == s->depth, "depth is not that of the anchors");
    for (axis = 0; axis < 3; axis++) {
        cgs__require(d, smallest[axis] < 16, "origin is not that of the anchors");
        cgs__require(d, origin[axis] >= INT32_MIN && origin[axis] + largest[axis] <= INT32_MAX,
                     "coordinates beyond 32 bits");
    }
    cgs__order(d, anchors, depth);
    s->coordinates = coordinates = (int32_t *)cgs__alloc(d, 3 * (uint64_t)anchors, sizeof *coordinates);
    for (i = 0; i < 3 * anchors; i++) coordinates[i] = (int32_t)(origin[i % 3] + d->offsets[i]);
}

/* ---- masks */

static void cgs__read_masks(cgs__decoder *d) {
    const uint32_t anchors = d->scene->total_anchors, slots = (uint32_t)d->scene->coupled_primitives;
    cgs__fields f = cgs__open(d, CGS__MASKS);
    uint8_t *mask = d->mask = (uint8_t *)cgs__alloc(d, (uint64_t)anchors * slots, 1);
    uint64_t exist = 0;
    uint32_t before = 0, i, k;
    cgs__mixer mixer;
    cgs__coder coder;
    if (!f.size) {
        memset(mask, 1, (size_t)anchors * slots);
        exist = (uint64_t)anchors * slots;
    } else {
        mixer = cgs__new_mixer(d, 3, 4160 + 16384 + 16640, 64 + 4, 64, 24576, 1000, 2);
        cgs__start(&coder, d, f.data, f.size);
        for (i = 0; i < anchors; i++, mask += slots) {
            uint32_t taken = 0, recent = 0;
            for (k = 0; k < slots; k++) {
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
        cgs__require(d, cgs__finish(&coder, d) == f.size, "the code does not end with the section");
        cgs__require(d, exist < (uint64_t)anchors * slots, "masks of ones are written out");
        cgs__release_mixer(d, &mixer);
    }
    cgs__require(d, exist == d->promised_coupled, "another number of coupled primitives than the scene has");
}

/* ---- latents */

typedef struct {
    uint64_t code;
    uint32_t anchor;
} cgs__place;

typedef struct {
    int level;
    uint32_t first, count, coupled;
} cgs__range;

static cgs__place *cgs__sorted_places(cgs__decoder *d, uint32_t anchors, int shift) {
    cgs__place *places = (cgs__place *)cgs__alloc(d, anchors, sizeof *places);
    uint32_t i;
    for (i = 0; i < anchors; i++) {
        places[i].code = cgs__morton(d->offsets + 3 * (size_t)i) >> (3 * shift);
        places[i].anchor = i;
    }
    qsort(places, anchors, sizeof *places, cgs__by_code);
    return places;
}

/* Anchors of earlier ranges around one; at most 27. */
static int cgs__neighbours(const cgs__place *places, uint32_t count, const int32_t *offset, int shift, uint32_t found[27]) {
    int near = 0, j;
    for (j = 0; j < 27; j++) {
        int32_t node[3];
        uint64_t code;
        uint32_t low = 0, high = count;
        int axis, inside = 1;
        node[0] = (offset[0] >> shift) + j / 9 - 1, node[1] = (offset[1] >> shift) + j / 3 % 3 - 1;
        node[2] = (offset[2] >> shift) + j % 3 - 1;
        for (axis = 0; axis < 3; axis++) inside &= node[axis] >= 0 && node[axis] < 1 << CGS__MAX_DEPTH;
        if (!inside) continue;
        code = cgs__morton(node);
        while (low < high) {
            const uint32_t middle = low + (high - low) / 2;
            if (places[middle].code < code) low = middle + 1;
            else high = middle;
        }
        if (low < count && places[low].code == code) found[near++] = places[low].anchor;
    }
    return near;
}

/* What an anchor's neighbours have of a group: known, activity, around of each channel. */
static void cgs__what_is_around(const cgs__decoder *d, int group, const cgs__place *places, uint32_t count, int shift,
                                uint32_t anchor, int64_t *said) {
    const cgs_group *g = d->scene->group + group;
    const cgs__network *n = d->network[group];
    const int32_t *bias = n->layer[n->layers - 1].bias, *own = d->offsets + 3 * (size_t)anchor;
    uint32_t found[27];
    const int near = cgs__neighbours(places, count, own, shift, found);
    int64_t total = 0;
    int j, c, axis;
    memset(said, 0, (2 + (size_t)g->channels) * sizeof *said);
    if (!near) return; /* never: their nodes are all those of the level */
    for (j = 0; j < near; j++) {
        const int32_t *other = d->offsets + 3 * (size_t)found[j];
        const int32_t *x = g->latents + (size_t)found[j] * (unsigned)g->channels;
        int64_t distance = 0, sizes = 0, weight;
        for (axis = 0; axis < 3; axis++) distance += own[axis] < other[axis] ? other[axis] - own[axis] : own[axis] - other[axis];
        weight = 1 + ((int64_t)1 << 24) / (distance ? distance : 1); /* anchors are in different places */
        for (c = 0; c < g->channels; c++) {
            const int64_t differs = cgs__activation((int64_t)x[c] - bias[c]);
            said[2 + c] += weight * differs;
            sizes += differs < 0 ? -differs : differs;
        }
        said[1] += weight * (sizes / g->channels);
        total += weight;
    }
    said[0] = CGS__ONE;
    said[1] /= total;
    for (c = 0; c < g->channels; c++) said[2 + c] = cgs__floor_div(said[2 + c], total);
}

/* Means and tables of the symbols of a range's group, in the order of its stream. */
static void cgs__expect(cgs__decoder *d, int group, const cgs__range *range, int earlier_level, int32_t *means,
                        uint8_t *index) {
    const cgs_scene *s = d->scene;
    const cgs_group *g = s->group + group;
    const cgs__network *n = d->network[group];
    const int width = cgs__width(s, group), widest = cgs__widest(n), sees = cgs__sees(s, group, group);
    const int shift = s->depth - earlier_level;
    int32_t *scratch = (int32_t *)cgs__alloc(d, 3 * (uint64_t)widest, sizeof *scratch);
    int32_t *inputs = (int32_t *)cgs__alloc(d, (uint64_t)cgs__inputs(s, group), sizeof *inputs);
    int64_t *said = (int64_t *)cgs__alloc(d, 2 + (uint64_t)g->channels, sizeof *said);
    cgs__place *places = sees && range->first ? cgs__sorted_places(d, range->first, shift) : NULL;
    const int32_t *bias = n->layer[n->layers - 1].bias;
    uint32_t anchor;
    for (anchor = range->first; anchor < range->first + range->count; anchor++) {
        const uint8_t *exists = d->mask + (size_t)anchor * (unsigned)s->coupled_primitives;
        const int32_t *out;
        int at = 0, j, c, k;
        for (k = 0; k < 3 && g->context & 1; k++)
            inputs[at++] = (int32_t)((((2 * (int64_t)d->offsets[3 * (size_t)anchor + (unsigned)k] + 1) << 12) >> s->depth) - CGS__ONE);
        for (j = 0; j < group; j++) {
            const int channels = s->group[j].channels;
            if (!cgs__sees(s, group, j)) continue;
            memcpy(inputs + at, s->group[j].latents + (size_t)anchor * (unsigned)channels, (size_t)channels * sizeof *inputs);
            at += channels;
        }
        if (places) cgs__what_is_around(d, group, places, range->first, shift, anchor, said);
        if (sees) inputs[at++] = (int32_t)said[0], inputs[at++] = (int32_t)said[1];
        out = cgs__evaluate(n, inputs, scratch, widest);
        for (c = 0; c < width; c++) {
            int64_t mean = out[c];
            if (g->role == CGS_RESIDUAL && !exists[c / g->channels]) continue;
            if (sees) {
                int64_t moved = n->follow[c] * said[2 + c];
                if (n->follow_shift) moved += (int64_t)1 << (n->follow_shift - 1);
                moved = cgs__right(moved, n->follow_shift) + mean - bias[c];
                mean = cgs__activation(bias[c] + cgs__right(moved + 2048, 12) * CGS__ONE);
            }
            *means++ = (int32_t)mean;
            *index++ = (uint8_t)cgs__clamp(cgs__right((int64_t)out[width + c] + 2048, 12), 0, CGS__GAUSSIAN_COUNT - 1);
        }
    }
    if (places) cgs__release(d, places);
    cgs__release(d, said);
    cgs__release(d, inputs);
    cgs__release(d, scratch);
}

static void cgs__tables_of(const cgs__decoder *d, int group, const cgs__range *range, uint8_t *index) {
    const cgs_scene *s = d->scene;
    const int width = cgs__width(s, group), channels = s->group[group].channels;
    uint32_t anchor;
    int c;
    for (anchor = range->first; anchor < range->first + range->count; anchor++) {
        const uint8_t *exists = d->mask + (size_t)anchor * (unsigned)s->coupled_primitives;
        for (c = 0; c < width; c++)
            if (s->group[group].role != CGS_RESIDUAL || exists[c / channels]) *index++ = (uint8_t)c;
    }
}

/* Steps of a row from its symbols. */
static void cgs__follow_chain(cgs__decoder *d, const int32_t *chain, int channels, int32_t *row) {
    int c, j;
    for (c = 1; c < channels; c++) {
        int64_t sum = 32;
        for (j = 0; j < c; j++) sum += (int64_t)*chain++ * row[j];
        sum = row[c] + cgs__right(sum, 6);
        cgs__require(d, sum >= -CGS__MAX_SYMBOL && sum <= CGS__MAX_SYMBOL, "a step beyond MAX_SYMBOL");
        row[c] = (int32_t)sum;
    }
}

static void cgs__read_group_latents(cgs__fields *f, int group, const cgs__range *range, int earlier_level, uint32_t primitive) {
    cgs__decoder *d = f->d;
    cgs_scene *s = d->scene;
    cgs_group *g = s->group + group;
    const cgs__network *n = d->network[group];
    const int is_residual = g->role == CGS_RESIDUAL, slots = cgs__slots(s, group);
    const uint64_t rows = is_residual ? range->coupled : range->count, count = rows * (unsigned)g->channels;
    int32_t *means = (int32_t *)cgs__alloc(d, count + 1, sizeof *means);
    int32_t *symbols = (int32_t *)cgs__alloc(d, count + 1, sizeof *symbols);
    uint8_t *index = (uint8_t *)cgs__alloc(d, count + 1, 1);
    int32_t *latents = g->latents + (size_t)(is_residual ? primitive : range->first) * (unsigned)g->channels;
    int32_t *all = g->symbols + (size_t)range->first * (unsigned)(slots * g->channels);
    const uint8_t *exists = d->mask + (size_t)range->first * (unsigned)s->coupled_primitives;
    const cgs__rows how = {g->channels, n ? n->inertia : 0};
    uint64_t i, row;
    if (n) cgs__expect(d, group, range, earlier_level, means, index);
    else cgs__tables_of(d, group, range, index);
    d->section = cgs__name(CGS__LATENTS);
    cgs__read_stream(f, n ? d->gaussian : d->tables[group], how, index, symbols, count);
    for (i = 0; i < count; i++)
        cgs__require(d, symbols[i] >= -CGS__MAX_SYMBOL && symbols[i] <= CGS__MAX_SYMBOL, "a symbol beyond MAX_SYMBOL");
    for (row = 0; row < rows; row++, all += g->channels) {
        if (is_residual)
            for (; !*exists; exists++) all += g->channels;
        exists += is_residual;
        memcpy(all, symbols + row * (unsigned)g->channels, (size_t)g->channels * sizeof *all);
    }
    for (row = 0; n && n->chain && row < rows; row++)
        cgs__follow_chain(d, n->chain, g->channels, symbols + row * (unsigned)g->channels);
    for (i = 0; i < count; i++) latents[i] = symbols[i] * CGS__ONE + means[i];
    cgs__release(d, index);
    cgs__release(d, symbols);
    cgs__release(d, means);
}

static uint32_t cgs__existing(const cgs__decoder *d, uint32_t first, uint32_t end) {
    const size_t slots = (size_t)d->scene->coupled_primitives;
    size_t i;
    uint32_t count = 0;
    for (i = first * slots; i < end * slots; i++) count += d->mask[i];
    return count;
}

/* Heads of the ranges that are there; how many. */
static int cgs__read_range_heads(cgs__decoder *d, cgs__range *ranges, cgs__fields *fields) {
    int count = 0, i;
    uint32_t first = 0;
    d->section = cgs__name(CGS__LATENTS);
    for (i = 0; i < d->sections; i++) {
        cgs__range *range = ranges + count;
        if (d->section_of[i].number != CGS__LATENTS) continue;
        fields[count] = cgs__fields_of(d, d->section_of[i].data, d->section_of[i].size);
        range->level = (int)cgs__varint(fields + count, 0, CGS__MAX_DEPTH, "level");
        range->first = first;
        range->count = (uint32_t)cgs__varint(fields + count, 1, CGS__MAX_ANCHORS, "range_anchors");
        range->coupled = (uint32_t)cgs__varint(fields + count, 0, 64 * (uint64_t)range->count, "range_coupled");
        first += range->count;
        count++;
    }
    return count;
}

static void cgs__check_ranges(cgs__decoder *d, const cgs__range *ranges, int count) {
    const int depth = d->scene->depth;
    int i, before = -1;
    d->section = cgs__name(CGS__LATENTS);
    for (i = 0; i < count; before = ranges[i++].level) {
        const cgs__range *r = ranges + i;
        cgs__require(d, r->level > before && r->level <= depth, "level of a range");
        cgs__require(d, r->first + (uint64_t)r->count == d->up_to_level[r->level], "range_anchors");
        cgs__require(d, r->coupled == cgs__existing(d, r->first, r->first + r->count), "range_coupled");
    }
    if (d->whole) cgs__require(d, before == depth, "level of the last range");
}

static void cgs__read_latents(cgs__decoder *d, const cgs__range *ranges, cgs__fields *fields, int count) {
    cgs_scene *s = d->scene;
    uint32_t primitive = 0;
    int g, i;
    for (g = 0; g < s->groups; g++) {
        cgs_group *group = s->group + g;
        group->rows = group->role == CGS_RESIDUAL ? s->coupled : s->anchors;
        group->latents = (int32_t *)cgs__alloc(d, (uint64_t)group->rows * (unsigned)group->channels + 1, sizeof(int32_t));
        group->symbols = (int32_t *)cgs__alloc(d, (uint64_t)s->anchors * (unsigned)cgs__width(s, g) + 1, sizeof(int32_t));
    }
    for (i = 0; i < count; i++) {
        for (g = 0; g < s->groups; g++)
            cgs__read_group_latents(fields + i, g, ranges + i, i ? ranges[i - 1].level : 0, primitive);
        cgs__end(fields + i);
        primitive += ranges[i].coupled;
    }
}

/* ---- optional sections */

static void cgs__check_metadata(cgs__decoder *d) {
    cgs__fields f;
    uint64_t entries;
    const uint8_t *before = NULL;
    uint64_t before_size = 0;
    if (!cgs__find(d, CGS__METADATA)) return;
    f = cgs__open(d, CGS__METADATA);
    cgs__require(d, f.size <= CGS__MAX_METADATA_BYTES, "too many bytes");
    for (entries = cgs__varint(&f, 0, CGS__MAX_METADATA_BYTES, "entries"); entries; entries--) {
        const uint64_t key_size = cgs__varint(&f, 0, CGS__MAX_METADATA_BYTES, "length of a key");
        const uint8_t *key = cgs__take(&f, key_size);
        const uint64_t value_size = cgs__varint(&f, 0, CGS__MAX_METADATA_BYTES, "length of a value");
        const uint8_t *value = cgs__take(&f, value_size);
        const size_t shared = (size_t)(before_size < key_size ? before_size : key_size);
        const int order = before ? memcmp(before, key, shared) : -1;
        cgs__require(d, order < 0 || (order == 0 && before_size < key_size), "keys are not in order");
        cgs__require(d, cgs__is_text(key, (size_t)key_size) && cgs__is_text(value, (size_t)value_size), "not UTF-8");
        before = key, before_size = key_size;
    }
    cgs__end(&f);
}

static void cgs__read_rotation(cgs__fields *f, double rotation[4]) {
    const uint64_t packed = cgs__unsigned(f, 6);
    const int largest = (int)(packed & 3);
    int64_t squares = 0;
    double rest = 1;
    int i, at = 0;
    cgs__require(f->d, !(packed >> 47), "bit 47 of a rotation");
    for (i = 0; i < 3; i++, at++) {
        const int raw = (int)(packed >> (2 + 15 * i) & 32767), value = raw < 16384 ? raw : raw - 32768;
        cgs__require(f->d, value > -16384, "a rotation");
        squares += (int64_t)value * value;
        at += at == largest;
        rotation[at] = value / (16383 * sqrt(2.0));
        rest -= rotation[at] * rotation[at];
    }
    cgs__require(f->d, squares <= (int64_t)3 << 27, "a rotation");
    rotation[largest] = sqrt(rest);
}

static float cgs__length(cgs__fields *f) {
    const float value = cgs__f32(f);
    cgs__require(f->d, value > 0 && value <= 3.4028234663852886e38f, "a length is not above 0 and finite");
    return value;
}

static void cgs__read_viewpoints(cgs__decoder *d) {
    cgs_scene *s = d->scene;
    cgs__fields f;
    cgs_view lens[16];
    float centre[3], radius;
    int lenses, i, k;
    if (!cgs__find(d, CGS__VIEWPOINTS)) return;
    f = cgs__open(d, CGS__VIEWPOINTS);
    for (i = 0; i < 3; i++) {
        s->up[i] = (int8_t)cgs__unsigned(&f, 1);
        cgs__require(d, s->up[i] >= -127, "up");
    }
    cgs__require(d, s->up[0] != 0 || s->up[1] != 0 || s->up[2] != 0, "up is no direction");
    for (i = 0; i < 3; i++) {
        centre[i] = cgs__f32(&f);
        cgs__require(d, cgs__is_within(centre[i], -3.4028234663852886e38, 3.4028234663852886e38), "centre");
    }
    radius = cgs__length(&f);
    lenses = (int)cgs__between(d, cgs__unsigned(&f, 1), 1, 16, "lenses");
    memset(lens, 0, sizeof lens);
    for (i = 0; i < lenses; i++) {
        lens[i].width = (int)cgs__between(d, cgs__unsigned(&f, 2), 1, 65535, "width of an image");
        lens[i].height = (int)cgs__between(d, cgs__unsigned(&f, 2), 1, 65535, "height of an image");
        lens[i].fx = cgs__length(&f);
        lens[i].fy = cgs__length(&f);
    }
    s->views = (int)cgs__between(d, cgs__unsigned(&f, 1), 1, 255, "views");
    s->view = (cgs_view *)cgs__alloc(d, (uint64_t)s->views, sizeof *s->view);
    for (i = 0; i < s->views; i++) {
        s->view[i] = lens[cgs__between(d, cgs__unsigned(&f, 1), 0, (uint64_t)lenses - 1, "lens of a view")];
        for (k = 0; k < 3; k++) {
            const int place = (int16_t)cgs__unsigned(&f, 2);
            cgs__require(d, place >= -32767, "position of a view");
            s->view[i].position[k] = centre[k] + (double)radius * place / 32767;
        }
        cgs__read_rotation(&f, s->view[i].rotation);
    }
    cgs__end(&f);
    {
        const double norm = sqrt(s->up[0] * s->up[0] + s->up[1] * s->up[1] + s->up[2] * s->up[2]);
        for (i = 0; i < 3; i++) s->up[i] /= norm;
    }
}

static void cgs__check_padding(cgs__decoder *d) {
    const cgs__section *padding = cgs__find(d, CGS__PADDING);
    size_t i;
    if (!padding) return;
    d->section = cgs__name(CGS__PADDING);
    for (i = 0; i < padding->size; i++) cgs__require(d, !padding->data[i], "a byte is not zero");
}

/* ---- the whole */

static void cgs__decode_all(cgs__decoder *d) {
    cgs_scene *s = d->scene;
    cgs__range ranges[CGS__MAX_RANGES];
    cgs__fields fields[CGS__MAX_RANGES];
    uint64_t width = 0;
    int count, g, i;
    cgs__unpack(d);
    cgs__read_scene(d);
    count = cgs__read_range_heads(d, ranges, fields);
    s->anchors = s->total_anchors, s->coupled = d->promised_coupled;
    if (d->prefix) {
        s->anchors = s->coupled = 0;
        for (i = 0; i < count; i++) s->anchors += ranges[i].count, s->coupled += ranges[i].coupled;
    }
    for (g = 0; g < s->groups; g++) width += (unsigned)cgs__width(s, g);
    d->section = cgs__name(CGS__SCENE);
    cgs__check(d, CGS__SYMBOLS, s->anchors * width, "more symbols than the file's length allows");
    cgs__check(d, CGS__FLAGS, (uint64_t)s->total_anchors * (unsigned)s->coupled_primitives,
               "more flags of masks than the file's length allows");
    cgs__check_padding(d);
    cgs__check_metadata(d);
    cgs__read_viewpoints(d);
    cgs__read_gaussians(d);
    cgs__make_arithmetic(d);
    cgs__read_tables(d);
    cgs__read_networks(d, s->anchors);
    cgs__read_heads(d, s->coupled);
    cgs__read_positions(d);
    cgs__read_masks(d);
    cgs__check_ranges(d, ranges, count);
    cgs__read_latents(d, ranges, fields, count);
    s->mask = d->mask;
}

cgs_error cgs_decode(const uint8_t *data, size_t size, int prefix, cgs_scene *scene) {
    static const uint8_t nothing[1] = {0};
    void (*const volatile decode_all)(cgs__decoder *) = cgs__decode_all; /* not inlined into what calls setjmp */
    cgs__decoder *d;
    volatile cgs_error error = CGS_OK;
    memset(scene, 0, sizeof *scene);
    d = (cgs__decoder *)calloc(1, sizeof *d);
    if (!d) {
        strcpy(scene->message, "out of memory");
        return CGS_OUT_OF_MEMORY;
    }
    d->scene = scene, d->data = size ? data : nothing, d->size = size, d->prefix = prefix;
    if (!setjmp(d->jump)) {
        decode_all(d);
        scene->memory = d->blocks;
    } else {
        char message[sizeof scene->message];
        memcpy(message, scene->message, sizeof message);
        error = d->error;
        cgs__free_all(d->blocks);
        memset(scene, 0, sizeof *scene);
        memcpy(scene->message, message, sizeof message);
    }
    free(d);
    return error;
}

void cgs_free(cgs_scene *scene) {
    cgs__free_all((cgs__block *)scene->memory);
    memset(scene, 0, sizeof *scene);
}

const char *cgs_error_name(cgs_error error) {
    static const char *const names[] = {"ok",
                                        "NotACompGSFile",
                                        "UnsupportedVersion",
                                        "TruncatedSection",
                                        "CorruptSection",
                                        "MissingDependency",
                                        "OutOfMemory"};
    return names[error];
}

/* ---- prediction (docs/bitstream_prediction.md) */

/* y += x W, columns side by side; x: one row. */
static void cgs__multiply(const cgs_tensor *w, const double *x, double *y) {
    const double unit = ldexp(1, -w->exponent);
    const int32_t *values = w->values;
    uint32_t i, o;
    for (i = 0; i < w->rows; i++)
        for (o = 0; o < w->columns; o++) y[o] += x[i] * unit * *values++;
}

static void cgs__add(const cgs_tensor *b, double *y) {
    uint32_t o;
    for (o = 0; o < b->columns; o++) y[o] += ldexp(b->values[o], -b->exponent);
}

static void cgs__leaky(double *y, int count) {
    while (count--) y[count] = y[count] >= 0 ? y[count] : y[count] / 64;
}

/* A residual MLP; `t` are its tensors. Returns those of the next. room: [3, width]. */
static const cgs_tensor *cgs__run_head(const cgs_tensor *t, int blocks, const double *x, double *out, double *room) {
    const int width = (int)t[0].columns;
    double *h = room, *u = room + width, *sum = room + 2 * (size_t)width;
    const cgs_tensor *block = t + 5;
    int i;
    memset(room, 0, 3 * (size_t)width * sizeof *room);
    memset(out, 0, t[2].columns * sizeof *out);
    cgs__multiply(t, x, h), cgs__add(t + 1, h), cgs__leaky(h, width);
    for (; blocks--; block += 4) {
        memset(u, 0, 2 * (size_t)width * sizeof *u);
        cgs__multiply(block, h, u), cgs__add(block + 1, u), cgs__leaky(u, width);
        cgs__multiply(block + 2, u, sum), cgs__add(block + 3, sum);
        for (i = 0; i < width; i++) h[i] += sum[i];
    }
    cgs__multiply(t + 2, h, out), cgs__add(t + 3, out), cgs__multiply(t + 4, x, out);
    return block;
}

/* The values of all groups of a role, side by side. */
static void cgs__dequantize(const cgs_scene *s, int role, uint32_t row, double *out) {
    int g, c;
    for (g = 0; g < s->groups; g++) {
        const cgs_group *group = s->group + g;
        if (group->role != role) continue;
        for (c = 0; c < group->channels; c++)
            *out++ = group->latents[(size_t)row * (unsigned)group->channels + (unsigned)c] / 4096.0
                   * group->step[group->steps > 1 ? c : 0];
    }
}

static double cgs__sigmoid(double x) { return 1 / (1 + exp(-x)); }

static int cgs__is_drawn(const double *gaussian) {
    const double *q = gaussian + 6, largest = ldexp(1, 127);
    int i;
    for (i = 0; i < CGS_GAUSSIAN; i++)
        if (!(fabs(gaussian[i]) < largest)) return 0;
    return gaussian[10] > 1 / 255.0 && sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) >= ldexp(1, -60);
}

long cgs_predict(const cgs_scene *s, const double center[3], float *out) {
    const cgs__head *head = s->separate_heads ? CGS__SEPARATE : CGS__PAIRED;
    const int heads = s->separate_heads ? 4 : 2, f = s->reference_dim, e = s->residual_dim;
    const int shared = !cgs__has_residuals(s);
    double *plain = (double *)calloc(2 * (size_t)(f + 4 + e) + 3 * (size_t)s->width, sizeof *plain);
    double *viewed = plain + f + e, *room = viewed + f + 4 + e, scales[6], position[3], offset[3];
    uint32_t anchor, primitive = 0;
    long count = 0;
    int slot, i;
    if (!plain) return -1;
    for (anchor = 0; anchor < s->anchors; anchor++) {
        double distance = 0;
        cgs__dequantize(s, CGS_REFERENCE, anchor, plain);
        memcpy(viewed, plain, (size_t)f * sizeof *plain);
        cgs__dequantize(s, CGS_LOG_SCALES, anchor, scales);
        for (i = 0; i < 6; i++) scales[i] = exp(scales[i]) * s->voxel_size; /* reach, then size */
        for (i = 0; i < 3; i++) {
            position[i] = s->coordinates[3 * (size_t)anchor + (unsigned)i] * s->voxel_size;
            offset[i] = position[i] - center[i];
            distance += offset[i] * offset[i];
        }
        distance = sqrt(distance);
        for (i = 0; i < 3; i++) viewed[f + i] = offset[i] / (distance > 1e-12 ? distance : 1e-12);
        viewed[f + 3] = distance / s->view_distance_scale;
        for (slot = 0; slot < s->coupled_primitives; slot++) {
            const cgs_tensor *t = s->tensor;
            double raw[14], g[CGS_GAUSSIAN], *r = raw, *a = raw + 10;
            if (!s->mask[(size_t)anchor * (unsigned)s->coupled_primitives + (unsigned)slot]) continue;
            if (shared) {
                const cgs_tensor *w = s->tensor + s->tensors - 1;
                for (i = 0; i < e; i++) plain[f + i] = ldexp(w->values[slot * e + i], -w->exponent);
            } else {
                cgs__dequantize(s, CGS_RESIDUAL, primitive, plain + f);
            }
            primitive++;
            memcpy(viewed + f + 4, plain + f, (size_t)e * sizeof *plain);
            for (i = 0; i < heads; r += head[i++].outputs)
                t = cgs__run_head(t, head[i].blocks, head[i].sees_view ? viewed : plain, r, room);
            r = raw;
            for (i = 0; i < 3; i++) {
                g[i] = position[i] + r[i] * scales[i];
                g[3 + i] = cgs__sigmoid(r[3 + i]) * scales[3 + i];
                g[11 + i] = cgs__sigmoid(a[1 + i]);
            }
            for (i = 0; i < 4; i++) g[6 + i] = r[6 + i] + (i == 0);
            g[10] = tanh(a[0]);
            if (!cgs__is_drawn(g)) continue;
            for (i = 0; i < CGS_GAUSSIAN; i++) *out++ = (float)g[i];
            count++;
        }
    }
    free(plain);
    return count;
}

#endif /* COMPGS_IMPLEMENTATION */
