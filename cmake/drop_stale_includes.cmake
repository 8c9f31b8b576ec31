# The Python generator targets of the pip wheels carry include paths of the machine that built
# the wheels. CMake refuses paths that do not exist, so those are dropped here; paths that exist
# (a ROS 2 distribution from apt) stay.
function(drop_stale_includes)
  foreach(package IN LISTS ARGN)
    set(target "${package}::${package}__rosidl_generator_py")
    if(TARGET ${target})
      get_target_property(paths ${target} INTERFACE_INCLUDE_DIRECTORIES)
      set(kept "")
      foreach(path IN LISTS paths)
        if(path MATCHES "^\\$<" OR EXISTS "${path}")
          list(APPEND kept "${path}")
        endif()
      endforeach()
      set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${kept}")
    endif()
  endforeach()
endfunction()
